"""LlavaVLA on ALOHA: SigLIP and Qwen3-0.6B, an action head of queries, three cameras.

fluxvla run --config configs/llava_aloha.py --section runner --nproc 8
fluxvla run --config configs/llava_aloha.py --section inference --task 1

``SIGLIP`` is a copy of google/siglip-so400m-patch14-224, ``QWEN`` one of Qwen/Qwen3-0.6B-Base,
``DATASET`` demonstrations in LeRobot's format. ``sizes`` are values of their ``config.json``, so
that a dry run needs neither.

Everything but the vision tower is trained, as in LLaVA's second stage, with its numbers (Liu et al.
2024, "Improved Baselines with Visual Instruction Tuning", and haotian-liu/LLaVA,
scripts/v1_5/finetune.sh): AdamW, 2e-5, no weight decay, 3 % of warm-up, a cosine, 128 samples a
step. The head is new and the steps are ours. Everything:
``--set model.freeze_vision_backbone=false``.
"""

SIGLIP = "models/siglip-so400m-patch14-224"
QWEN = "models/Qwen3-0.6B-Base"
DATASET = "datasets/aloha_example"
CAMERAS = ["cam_high", "cam_left_wrist", "cam_right_wrist"]
HORIZON = 50  # 1 s at 50 Hz

model = dict(
    type="LlavaVLA",
    vision_backbone=dict(
        type="SigLIPBackbone",
        model_folder=SIGLIP,
        num_cameras=len(CAMERAS),
        sizes=dict(
            model_type="siglip_vision_model",
            hidden_size=1152,
            intermediate_size=4304,
            num_hidden_layers=27,
            num_attention_heads=16,
            image_size=224,
            patch_size=14,
        ),
    ),
    projector=dict(type="FusedMLPProjector"),
    llm_backbone=dict(
        type="Qwen3Backbone",
        model_folder=QWEN,
        sizes=dict(
            model_type="qwen3",
            hidden_size=1024,
            intermediate_size=3072,
            num_hidden_layers=28,
            num_attention_heads=16,
            num_key_value_heads=8,
            head_dim=128,
            vocab_size=151936,
        ),
    ),
    vla_head=dict(type="LlavaActionHead", horizon=HORIZON, action_dim=14, state_dim=14),
    freeze_vision_backbone=True,
)

train_dataloader = dict(
    per_device_batch_size=16,
    per_device_num_workers=4,
    dataset=dict(
        type="ParquetDataset",
        data_root_path=DATASET,
        img_keys=CAMERAS,
        action_window_size=HORIZON,
        transforms=[
            dict(type="ResizeImages", height=224, width=224),
            dict(type="SimpleNormalizeImages"),
            dict(
                type="NormalizeStatesAndActions",
                state_key="proprio",
                action_key="action",
                norm_type="mean_std",
                std_floor=0.01,
            ),
            dict(
                type="ProcessPrompts",
                tokenizer=dict(type="PretrainedTokenizer", model_path=QWEN),
                max_len=48,
            ),
        ],
    ),
)

runner = dict(
    type="FSDPTrainRunner",
    max_steps=20000,
    learning_rate=2e-5,
    weight_decay=0.0,
    lr_scheduler_type="linear-warmup+cosine-decay",
    warmup_ratio=0.03,
    max_grad_norm=1.0,
    save_iter_interval=1000,
    max_keep_ckpts=2,
    seed=7,
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
            "sample_ids",
        ],
        meta_keys=["task_description", "prompt", "info", "stats", "timestamp"],
    ),
    metric=dict(type="VLAMetric", active_trackers=("jsonl",)),
)

inference = dict(
    type="AlohaInferenceRunner",
    seed=7,
    task_descriptions={"1": "put the red cube into the box"},
    execute_horizon=25,
    # A real robot also needs arms="arx_x5" or "piper": connecting is refused without it.
    operator=dict(type="AlohaOperator"),
)
