"""GR00T N1.5 fine-tuned on a UR arm with two cameras; see ``gr00t_n15_aloha.py``.

pip install fluxvla-gr00t fluxvla-fsdp fluxvla-ur
fluxvla run --config configs/gr00t_n15_ur.py --section runner --nproc 8
fluxvla run --config configs/gr00t_n15_ur.py --section inference --task 1
"""

_base_ = "gr00t_n15_aloha.py"

EAGLE = "work_dirs/models/eagle2_hg_model"
CAMERAS = ["cam_high", "cam_left_wrist"]
TRANSFORMS = [
    dict(
        type="ProcessPromptsWithImage",
        max_len=644,  # 2 x 256 places for images, and the words
        num_images=2,
        tokenizer=dict(type="PretrainedTokenizer", model_path=EAGLE),
    ),
    dict(type="ResizeImages", height=224, width=224),
    dict(type="NormalizeImages", means=[[127.5] * 3], stds=[[127.5] * 3]),
    dict(
        type="NormalizeStatesAndActions",
        state_dim=64,
        action_dim=32,
        state_key="proprio",
        action_key="action",
        norm_type="mean_std",
    ),
]

model = dict(vla_head=dict(ori_action_dim=7))

train_dataloader = dict(
    dataset=dict(
        data_root_path="work_dirs/ur/dataset",
        img_keys=CAMERAS,
        transforms=[
            *TRANSFORMS,
            dict(type="SampleFlowNoise", distribution="beta", alpha=1.5, beta=1.0),
        ],
    )
)

inference = dict(
    type="URInferenceRunner",
    task_descriptions={"1": "pick up the red cup", "2": "place it on the shelf"},
    dataset=dict(img_keys=CAMERAS, transforms=TRANSFORMS),
    denormalize_action=dict(action_dim=7),
    operator=dict(_delete_=True, type="UROperator"),
)
