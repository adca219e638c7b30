"""GR00T N1.5 fine-tuned on LIBERO-Object with two cameras; see ``gr00t_n15_aloha.py``.

pip install fluxvla-gr00t fluxvla-fsdp 'fluxvla-libero[libero]'
fluxvla run --config configs/gr00t_n15_libero.py --section runner --nproc 8
fluxvla run --config configs/gr00t_n15_libero.py --section eval

``DATASET`` as in ``gr00t_n17_libero.py``. Layers are those of NVIDIA's ``new_embodiment``.
"""

_base_ = "gr00t_n15_aloha.py"

EAGLE = "work_dirs/models/eagle2_hg_model"
DATASET = "work_dirs/libero_object/dataset"

train_dataloader = dict(
    dataset=dict(
        data_root_path=DATASET,
        img_keys=["agentview", "robot0_eye_in_hand"],
        embodiment_id=31,
        transforms=[
            dict(
                type="ProcessPromptsWithImage",
                max_len=644,  # 2 x 256 image tokens, and the words
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
                norm_type="min_max",
            ),
            dict(type="SampleFlowNoise", distribution="beta", alpha=1.5, beta=1.0),
        ],
    )
)

model = dict(vla_head=dict(ori_action_dim=7))

eval = dict(
    type="LiberoEvalRunner",
    task_suite_name="libero_object",
    tasks=[0, 2, 4],
    seed=7,
    num_trials_per_task=50,
    eval_chunk_size=8,
    instruction_swap=True,
)

inference = dict(
    _delete_=True,
    type="LiberoInferenceRunner",
    task_suite_name="libero_object",
    seed=7,
    eval_chunk_size=8,
)
