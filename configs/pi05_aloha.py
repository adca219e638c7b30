"""PI0.5 on ALOHA, fine-tuned from a published base model.

fluxvla run --config configs/pi05_aloha.py --section runner --nproc 8
fluxvla run --config configs/pi05_aloha.py --section inference --task 1

The weights are a folder of openpi's or LeRobot's, named by ``pretrained_name_or_path``; the
tokenizer is PaliGemma's ``tokenizer.json``.
"""

WEIGHTS = "checkpoints/pi05_base"
TOKENIZER = "checkpoints/paligemma-3b-pt-224"
DATASET = "datasets/aloha_example"
TASKS = {"1": "put the red cube into the box"}
HORIZON = 50
JOINTS = 14

model = dict(
    type="PI05FlowMatching",
    variant="gemma_2b",
    expert_variant="gemma_300m",
    vision_variant="so400m",
    n_action_steps=HORIZON,
    max_action_dim=32,
    ori_action_dim=JOINTS,
    num_steps=10,
    pretrained_name_or_path=WEIGHTS,
)

train_dataloader = dict(
    per_device_batch_size=8,
    per_device_num_workers=4,
    dataset=dict(
        type="ParquetDataset",
        data_root_path=DATASET,
        img_keys=["cam_high", "cam_left_wrist", "cam_right_wrist"],
        action_window_size=HORIZON,
        transforms=[
            dict(type="ResizeImagesWithPad", height=224, width=224),
            dict(type="SimpleNormalizeImages"),
            # openpi's: quantiles, and 1e-6 added; states are not padded, they stand in the prompt.
            dict(
                type="NormalizeStatesAndActions",
                state_key="proprio",
                action_key="action",
                norm_type="quantile",
                action_dim=32,
            ),
            dict(type="PreparePromptWithState"),
            dict(
                type="ProcessPrompts",
                tokenizer=dict(type="PretrainedTokenizer", model_path=TOKENIZER),
                max_len=200,
            ),
            dict(type="SampleFlowNoise", repeats=1, distribution="beta", alpha=1.5, beta=1.0),
        ],
    ),
)

# openpi's recipe (src/openpi/training/config.py, TrainConfig, and optimizer.py): AdamW with betas
# 0.9 and 0.95, weight decay 1e-10, 1000 steps of warm-up to 2.5e-5, cosine over 30000 (there to a
# tenth), clipping at 1, EMA 0.99; 64 samples a step, as its pi05_aloha_pen_uncap, with 8 processes.
# Its ALOHA configs count the arms' joints from the present state: relative_actions=True of the
# dataset.
runner = dict(
    type="FSDPTrainRunner",
    sharding_strategy="full-shard",
    max_steps=30000,
    learning_rate=2.5e-5,
    optimizer=dict(type="AdamW", betas=(0.9, 0.95), eps=1e-8),
    weight_decay=1e-10,
    max_grad_norm=1.0,
    lr_scheduler_type="linear-warmup+cosine-decay",
    warmup_ratio=1000 / 30000,
    ema_decay=0.99,
    save_iter_interval=1000,
    max_keep_ckpts=2,
    seed=42,
    enable_mixed_precision_training=True,
    mixed_precision_dtype="bf16",
    enable_gradient_checkpointing=True,
    collator=dict(
        type="DictCollator",
        keys=[
            "images",
            "img_masks",
            "states",
            "actions",
            "action_masks",
            "lang_tokens",
            "lang_masks",
            "noise",
            "time",
            "sample_ids",
        ],
        meta_keys=["task_description", "prompt", "info", "stats", "timestamp"],
    ),
    metric=dict(type="VLAMetric", active_trackers=("jsonl",)),
)

inference = dict(
    type="AlohaInferenceRunner",
    seed=7,
    task_descriptions=TASKS,
    execute_horizon=25,
    # A real robot also needs arms="arx_x5" or "piper": connecting is refused without it.
    operator=dict(type="AlohaOperator"),
)
