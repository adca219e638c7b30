"""ALOHA in simulation, the hand-over of a cube, by Diffusion Policy (Chi et al. 2023).

fluxvla collect aloha --out work_dirs/aloha_sim_diffusion/dataset --tasks transfer_cube \
    --episodes 200
fluxvla run --config configs/aloha_sim_diffusion.py --section runner
fluxvla run --config configs/aloha_sim_diffusion.py --section eval
fluxvla run --config configs/aloha_sim_diffusion.py --section inference --task 1

Hyperparameters are those of the convolutional policy in the appendix of arXiv 2303.04137 and of the
authors' real-stanford/diffusion_policy (config/train_diffusion_unet_hybrid_workspace.yaml): two
observations, the present one and that of the action before, 16 actions; 8 are executed. Acting
takes 10 steps of DDIM here, 100 of DDPM there; clipping and the number of steps are LeRobot's.
"""

DATASET = "work_dirs/aloha_sim_diffusion/dataset"
OBSERVATIONS = 2
HORIZON = 16  # 1.6 s at 10 Hz; a chunk begins with the action of the first observation
STEPS = 100

model = dict(
    type="DiffusionPolicy",
    state_dim=14,
    action_dim=14,
    horizon=HORIZON,
    num_cameras=1,
    n_obs_steps=OBSERVATIONS,
    backbone="resnet18",
    backbone_norm="group",
    keypoints=32,
    crop_shape=(128, 176),
    down_dims=(512, 1024, 2048),
    noise_scheduler_type="DDIM",
    num_train_timesteps=STEPS,
    num_inference_steps=10,
)

train_dataloader = dict(
    per_device_batch_size=64,
    per_device_num_workers=0,
    dataset=dict(
        type="ParquetDataset",
        data_root_path=DATASET,
        img_keys=["top"],
        action_window_size=HORIZON,
        n_obs_steps=OBSERVATIONS,
        past_actions=OBSERVATIONS - 1,
        cache_frames=True,
        transforms=[
            dict(type="ResizeImages", height=144, width=192),
            dict(type="SimpleNormalizeImages"),
            # Estimates of actions are clipped to -1..1 on the way from noise to a chunk.
            dict(
                type="NormalizeStatesAndActions",
                state_key="proprio",
                action_key="action",
                norm_type="min_max",
                std_floor=0.01,
            ),
            dict(type="SampleDiffusionNoise", num_train_timesteps=STEPS),
        ],
    ),
)

runner = dict(
    type="FSDPTrainRunner",
    max_steps=100_000,
    learning_rate=1e-4,
    weight_decay=1e-6,
    optimizer=dict(type="AdamW", betas=(0.95, 0.999)),
    max_grad_norm=10.0,
    lr_scheduler_type="linear-warmup+cosine-decay",
    warmup_ratio=0.005,
    ema_decay=0.9999,
    save_iter_interval=5_000,
    max_keep_ckpts=2,
    seed=7,
    collator=dict(
        type="DictCollator",
        keys=[
            "images",
            "states",
            "actions",
            "action_masks",
            "noise",
            "timesteps",
            "crops",
            "sample_ids",
        ],
        meta_keys=["img_masks", "task_description", "prompt", "info", "stats", "timestamp"],
    ),
    metric=dict(type="VLAMetric", active_trackers=("jsonl",)),
)

eval = dict(
    type="AlohaSimEvalRunner",
    episodes=50,
    seed=500,
    replan_every=HORIZON // 2,
)

inference = dict(
    type="AlohaInferenceRunner",
    seed=7,
    task_descriptions={"1": "hand the cube over to the left arm"},
    execute_horizon=HORIZON // 2,
    max_publish_step=300,
    operator=dict(
        type="AlohaSimOperator", arms="viperx300", camera_names=("top",), height=144, width=192
    ),
)
