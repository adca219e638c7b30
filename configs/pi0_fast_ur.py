"""PI0-FAST on a UR with a gripper and two cameras; see ``pi0_fast_libero.py``.

fluxvla run --config configs/pi0_fast_ur.py --section runner --nproc 8
fluxvla run --config configs/pi0_fast_ur.py --section inference --task 1

A chunk is one second, as in the paper (arXiv 2501.09747), where one of 7 joints
takes some 30 tokens.
"""

_base_ = "pi0_fast_libero.py"

TOKENIZER = "checkpoints/paligemma-3b-pt-224"
FAST = dict(type="FastTokenizer", model_path="checkpoints/pi0fast_base/fast-action-tokenizer")
DATASET = "datasets/ur5e_example"
HORIZON = 30  # 1 s at 30 Hz
DIMENSIONS = 7

model = dict(n_action_steps=HORIZON, action_dim=DIMENSIONS, max_decoding_steps=96)

train_dataloader = dict(
    dataset=dict(
        data_root_path=DATASET,
        img_keys=["cam_high", "cam_left_wrist"],
        action_window_size=HORIZON,
        transforms=[
            dict(type="ResizeImagesWithPad", height=224, width=224),
            dict(type="SimpleNormalizeImages"),
            dict(
                type="NormalizeStatesAndActions",
                state_key="proprio",
                action_key="action",
                norm_type="quantile",
            ),
            dict(type="PreparePromptWithState", ending=""),
            dict(
                type="ProcessPrompts",
                tokenizer=dict(type="PretrainedTokenizer", model_path=TOKENIZER),
                max_len=84,
            ),
            dict(type="ProcessActionTokens", tokenizer=FAST, max_len=96),
        ],
    )
)

eval = None

inference = dict(
    _delete_=True,
    type="URInferenceRunner",
    seed=7,
    task_descriptions={"1": "pick up the red cube"},
    execute_horizon=15,
    operator=dict(type="UROperator"),
)
