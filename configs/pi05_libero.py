"""PI0.5 on LIBERO-Object, fine-tuned from a published base model.

fluxvla run --config configs/pi05_libero.py --section runner --nproc 8
fluxvla run --config configs/pi05_libero.py --section eval

openpi's ``pi05_libero`` (Physical-Intelligence/openpi, src/openpi/training/config.py): chunks of 10
actions, no state in the prompt, 256 samples a step (with 8 processes), 30000 steps, of which 10000
of warm-up to 5e-5, which stays, AdamW with betas 0.9 and 0.95, clipping at 1, EMA 0.999. It acts on
5 actions of a chunk (examples/libero/main.py). Two things differ: openpi crops, rotates and
recolours images in training (src/openpi/models/model.py), and counts the padding of actions in the
loss, which ``ori_action_dim=None`` does here.
"""

_base_ = "pi05_aloha.py"

TOKENIZER = "checkpoints/paligemma-3b-pt-224"
DATASET = "datasets/libero_object"
HORIZON = 10
EXECUTED = 5

model = dict(n_action_steps=HORIZON, ori_action_dim=7)

train_dataloader = dict(
    per_device_batch_size=32,
    dataset=dict(
        data_root_path=DATASET,
        img_keys=["agentview", "robot0_eye_in_hand"],
        action_window_size=HORIZON,
        transforms=[
            dict(type="ResizeImagesWithPad", height=224, width=224),
            dict(type="SimpleNormalizeImages"),
            dict(
                type="NormalizeStatesAndActions",
                state_key="proprio",
                action_key="action",
                norm_type="quantile",
                action_dim=32,
            ),
            dict(type="PreparePrompt"),
            dict(
                type="ProcessPrompts",
                tokenizer=dict(type="PretrainedTokenizer", model_path=TOKENIZER),
                max_len=200,
            ),
            dict(type="SampleFlowNoise", repeats=1, distribution="beta", alpha=1.5, beta=1.0),
        ],
    ),
)

runner = dict(
    learning_rate=5e-5,
    lr_scheduler_type="constant",
    warmup_ratio=10000 / 30000,
    ema_decay=0.999,
)

eval = dict(
    type="LiberoEvalRunner",
    task_suite_name="libero_object",
    seed=7,
    num_trials_per_task=50,
    eval_chunk_size=EXECUTED,
)

inference = dict(
    _delete_=True,
    type="LiberoInferenceRunner",
    task_suite_name="libero_object",
    seed=7,
    eval_chunk_size=EXECUTED,
)
