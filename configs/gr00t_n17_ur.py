"""GR00T N1.7 fine-tuned on a UR arm with two cameras; see ``gr00t_n17_libero.py``.

pip install fluxvla-gr00t fluxvla-fsdp fluxvla-ur
fluxvla run --config configs/gr00t_n17_ur.py --section runner --nproc 8
fluxvla run --config configs/gr00t_n17_ur.py --section inference --task 1

Layers are those of NVIDIA's ``new_embodiment``; 40 actions are a chunk, as in the published model.
"""

_base_ = "gr00t_n17_libero.py"

QWEN = "work_dirs/models/Cosmos-Reason2-2B"
DATASET = "work_dirs/ur/dataset"

model = dict(vla_head=dict(ori_action_dim=7))

train_dataloader = dict(
    dataset=dict(
        data_root_path=DATASET,
        img_keys=["cam_high", "cam_left_wrist"],
        embodiment_id=10,
        transforms=[
            dict(type="ResizeCropImages", size=256, method="area"),
            dict(
                type="ProcessQwenPrompts",
                max_len=288,  # 2 x 88 image tokens of a 4:3 image, and the words
                tokenizer=dict(type="PretrainedTokenizer", model_path=QWEN),
            ),
            dict(type="SimpleNormalizeImages"),
            dict(
                type="NormalizeStatesAndActions",
                state_dim=132,
                action_dim=132,
                state_key="proprio",
                action_key="action",
                norm_type="quantile",
                std_floor=0.01,
            ),
            dict(type="ClipNormalized"),
            dict(type="SampleFlowNoise", distribution="beta", alpha=1.5, beta=1.0),
        ],
    )
)

eval = None

inference = dict(
    _delete_=True,
    type="URInferenceRunner",
    seed=7,
    task_descriptions={"1": "pick up the red cube"},
    execute_horizon=20,
    operator=dict(type="UROperator"),
)
