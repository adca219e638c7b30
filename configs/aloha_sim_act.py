"""ALOHA in simulation, the hand-over of a cube, by ACT (Zhao et al. 2023, arXiv 2304.13705).

fluxvla collect aloha --out work_dirs/aloha_sim_act/dataset --tasks transfer_cube --episodes 50 \
    --fps 50 --height 480 --width 640
fluxvla run --config configs/aloha_sim_act.py --section runner
fluxvla run --config configs/aloha_sim_act.py --section eval
fluxvla run --config configs/aloha_sim_act.py --section inference --task 1

Hyperparameters are those of the paper's appendix; steps and clipping are LeRobot's
(src/lerobot/policies/act/configuration_act.py, src/lerobot/configs/train.py). In the paper the
residual network has been trained on ImageNet. Here it is trained from nothing, with group
normalisation. To go on from a policy that LeRobot trained:
--set runner.init_from=FOLDER --set model.backbone_norm=frozen_batch.
"""

DATASET = "work_dirs/aloha_sim_act/dataset"
HORIZON = 100  # 2 s at 50 Hz

model = dict(
    type="ACT",
    state_dim=14,
    action_dim=14,
    horizon=HORIZON,
    num_cameras=1,
    backbone="resnet18",
    backbone_norm="group",
    dim_model=512,
    n_heads=8,
    dim_feedforward=3200,
    n_encoder_layers=4,
    n_decoder_layers=1,  # the authors' code uses the first of its seven only
    latent_dim=32,
    dropout=0.1,
    kl_weight=10.0,
)

train_dataloader = dict(
    per_device_batch_size=8,
    per_device_num_workers=2,
    dataset=dict(
        type="ParquetDataset",
        data_root_path=DATASET,
        img_keys=["top"],
        action_window_size=HORIZON,
        transforms=[
            dict(type="ResizeImages", height=480, width=640),
            dict(
                type="NormalizeImages",
                means=[[0.485, 0.456, 0.406]],
                stds=[[0.229, 0.224, 0.225]],
                scale_to_unit_interval=True,
            ),
            dict(
                type="NormalizeStatesAndActions",
                state_key="proprio",
                action_key="action",
                norm_type="mean_std",
                std_floor=0.01,
            ),
            dict(type="SampleLatentNoise", dim=32),
        ],
    ),
)

runner = dict(
    type="FSDPTrainRunner",
    max_steps=100_000,
    learning_rate=1e-5,
    weight_decay=1e-4,
    max_grad_norm=10.0,  # LeRobot's
    lr_scheduler_type="constant",
    save_iter_interval=5_000,
    max_keep_ckpts=2,
    seed=7,
    collator=dict(
        type="DictCollator",
        keys=["images", "states", "actions", "action_masks", "latent_noise", "sample_ids"],
        meta_keys=["img_masks", "task_description", "prompt", "info", "stats", "timestamp"],
    ),
    metric=dict(type="VLAMetric", active_trackers=("jsonl",)),
)

eval = dict(
    type="AlohaSimEvalRunner",
    episodes=50,
    seed=500,
    replan_every=HORIZON,
)

inference = dict(
    type="AlohaInferenceRunner",
    seed=7,
    task_descriptions={"1": "hand the cube over to the left arm"},
    # The paper averages all chunks that cover a moment, which asks for a new one at every step.
    chunk_joining=dict(method="temporal_ensemble", coefficient=0.01),
    max_publish_step=400,
    operator=dict(
        type="AlohaSimOperator", arms="viperx300", camera_names=("top",), height=480, width=640
    ),
)
