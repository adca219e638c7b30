"""GR00T N1.5 fine-tuned on a real ALOHA: NVIDIA's published weights, three cameras, 14 joints.

    pip install fluxvla-gr00t fluxvla-fsdp fluxvla-aloha

``PRETRAINED`` is the folder of nvidia/GR00T-N1.5-3B, ``EAGLE`` that of its tokenizer
(lerobot/eagle2hg-processor-groot-n1p5), ``DATASET`` demonstrations in LeRobot's format.

    fluxvla run --config configs/gr00t_n15_aloha.py --section runner --nproc 8
    fluxvla run --config configs/gr00t_n15_aloha.py --section inference --task 1

The backbone is frozen, as NVIDIA's fine-tuning leaves it; ``--set model.freeze_vlm_backbone=false``
trains all of it.
"""

PRETRAINED = "work_dirs/models/GR00T-N1.5-3B"
EAGLE = "work_dirs/models/eagle2_hg_model"
DATASET = "work_dirs/aloha/dataset"
EMBODIMENT = 0  # layers of the head that no robot of NVIDIA's has
HORIZON = 16
CAMERAS = ["cam_high", "cam_left_wrist", "cam_right_wrist"]
TASKS = {
    "1": "place it on the blue plate with right arm",
    "2": "pick up the green bowl with right arm",
}
TRANSFORMS = [
    dict(
        type="ProcessPromptsWithImage",
        max_len=900,  # 3 x 256 places for images, and the words
        num_images=3,
        tokenizer=dict(type="PretrainedTokenizer", model_path=EAGLE),
    ),
    dict(type="ResizeImages", height=224, width=224),
    # What the published vision tower was trained with.
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

model = dict(
    type="GR00T",
    vlm_backbone=dict(type="EagleBackbone"),
    vla_head=dict(type="GR00TActionHead", horizon=HORIZON, ori_action_dim=14),
    freeze_vlm_backbone=True,
    pretrained_name_or_path=PRETRAINED,
)

train_dataloader = dict(
    per_device_batch_size=32,
    per_device_num_workers=4,
    dataset=dict(
        type="ParquetDataset",
        data_root_path=DATASET,
        img_keys=CAMERAS,
        action_window_size=HORIZON,
        embodiment_id=EMBODIMENT,
        transforms=[
            *TRANSFORMS,
            # 1 - t from Beta(1.5, 1): arXiv 2503.14734, section 2.1.
            dict(type="SampleFlowNoise", distribution="beta", alpha=1.5, beta=1.0),
        ],
    ),
)

runner = dict(
    type="FSDPTrainRunner",
    max_steps=10000,
    # NVIDIA's fine-tuning of N1.5 (NVIDIA/Isaac-GR00T, scripts/gr00t_finetune.py): AdamW, 32
    # samples a GPU, 10 000 steps, 1e-4 after 5 % of warm-up, a cosine.
    learning_rate=1e-4,
    weight_decay=1e-5,
    optimizer=dict(type="AdamW", betas=(0.95, 0.999)),
    lr_scheduler_type="linear-warmup+cosine-decay",
    warmup_ratio=0.05,
    max_grad_norm=1.0,
    save_iter_interval=1000,
    max_keep_ckpts=2,
    seed=7,
    enable_mixed_precision_training=True,
    mixed_precision_dtype="bf16",
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
            "embodiment_ids",
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
    dataset=dict(
        type="PrivateInferenceDataset",
        embodiment_id=EMBODIMENT,
        img_keys=CAMERAS,
        transforms=TRANSFORMS,
    ),
    denormalize_action=dict(type="DenormalizePrivateAction", norm_type="mean_std", action_dim=14),
    # A real robot also needs arms="arx_x5" or "piper": connecting is refused without it.
    operator=dict(type="AlohaOperator"),
)
