"""PI0-FAST on ALOHA; see ``pi0_fast_libero.py``.

fluxvla run --config configs/pi0_fast_aloha.py --section runner --nproc 8
fluxvla run --config configs/pi0_fast_aloha.py --section inference --task 1

A chunk is one second, as in the paper (arXiv 2501.09747), where one of 14 joints at 50 Hz
takes some 50 tokens.
"""

_base_ = "pi0_fast_libero.py"

TOKENIZER = "checkpoints/paligemma-3b-pt-224"
FAST = dict(type="FastTokenizer", model_path="checkpoints/pi0fast_base/fast-action-tokenizer")
DATASET = "datasets/aloha_example"
HORIZON = 50  # 1 s at 50 Hz
DIMENSIONS = 14

model = dict(n_action_steps=HORIZON, action_dim=DIMENSIONS, max_decoding_steps=256)

train_dataloader = dict(
    dataset=dict(
        data_root_path=DATASET,
        img_keys=["cam_high", "cam_left_wrist", "cam_right_wrist"],
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
                max_len=140,
            ),
            dict(type="ProcessActionTokens", tokenizer=FAST, max_len=256),
        ],
    )
)

eval = None

inference = dict(
    _delete_=True,
    type="AlohaInferenceRunner",
    seed=7,
    task_descriptions={"1": "put the red cube into the box"},
    execute_horizon=25,
    # A real robot also needs arms="arx_x5" or "piper": connecting is refused without it.
    operator=dict(type="AlohaOperator"),
)
