r"""GR00T N1.7 fine-tuned on LIBERO-Object: NVIDIA's published weights, two cameras.

    pip install fluxvla-gr00t fluxvla-fsdp 'fluxvla-libero[libero]'

``PRETRAINED`` is the folder of nvidia/GR00T-N1.7-3B, ``QWEN`` that of its tokenizer
(nvidia/Cosmos-Reason2-2B).

    fluxvla data collect --env LiberoEnvironment --out work_dirs/libero_object/dataset \
        --episodes 144 --cameras agentview robot0_eye_in_hand --height 256 --width 256 \
        --set 'env.tasks=[0, 2, 4]'
    fluxvla run --config configs/gr00t_n17_libero.py --section runner --nproc 8
    fluxvla run --config configs/gr00t_n17_libero.py --section eval
"""

PRETRAINED = "work_dirs/models/GR00T-N1.7-3B"
QWEN = "work_dirs/models/Cosmos-Reason2-2B"
DATASET = "work_dirs/libero_object/dataset"
HORIZON = 40  # the chunk that N1.7 was trained with; 2 s at 20 Hz
TASKS = [0, 2, 4]

model = dict(
    type="GR00T",
    vlm_backbone=dict(type="Qwen3VLBackbone"),
    vla_head=dict(
        type="GR00TActionHead",
        horizon=HORIZON,
        action_dim=132,
        state_dim=132,
        ori_action_dim=7,
        layers=32,
        future_tokens=0,
        attend_text_every=2,
        state_dropout=0.2,
    ),
    freeze_vlm_backbone=True,
    pretrained_name_or_path=PRETRAINED,
)

train_dataloader = dict(
    per_device_batch_size=32,
    per_device_num_workers=4,
    dataset=dict(
        type="ParquetDataset",
        data_root_path=DATASET,
        img_keys=["agentview", "robot0_eye_in_hand"],
        action_window_size=HORIZON,
        embodiment_id=2,  # libero_sim
        transforms=[
            dict(type="ResizeCropImages", size=256, method="area"),
            dict(
                type="ProcessQwenPrompts",
                max_len=256,  # 2 x 64 places for images, and the words
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
            # 1 - t from Beta(1.5, 1): arXiv 2503.14734, section 2.1.
            dict(type="SampleFlowNoise", distribution="beta", alpha=1.5, beta=1.0),
        ],
    ),
)

runner = dict(
    type="FSDPTrainRunner",
    max_steps=20000,
    # NVIDIA's fine-tuning of N1.7 (NVIDIA/Isaac-GR00T, gr00t/configs/finetune_config.py and
    # training/training_config.py): AdamW (0.9, 0.999), 1e-4 after 5 % of warm-up, a cosine. 20 000
    # steps as in examples/LIBERO/README.md, where one has 640 samples: per_device_batch_size=80.
    learning_rate=1e-4,
    weight_decay=1e-5,
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

eval = dict(
    type="LiberoEvalRunner",
    task_suite_name="libero_object",
    tasks=TASKS,
    seed=7,
    num_trials_per_task=50,
    eval_chunk_size=8,  # as examples/LIBERO/README.md executes
    instruction_swap=True,
)

inference = dict(
    type="LiberoInferenceRunner",
    task_suite_name="libero_object",
    seed=7,
    eval_chunk_size=8,
)
