r"""LIBERO-Object, one task, by Diffusion Policy, which reads no instructions.

    fluxvla data collect --env LiberoEnvironment --out work_dirs/libero_diffusion/dataset \
        --episodes 50 --cameras agentview robot0_eye_in_hand --height 128 --width 128 \
        --set 'env.tasks=[0]'
    fluxvla run --config configs/libero_diffusion.py --section runner
    fluxvla run --config configs/libero_diffusion.py --section eval

Hyperparameters are those of ``aloha_sim_diffusion.py``; images and crops those that the paper has
for robomimic's, whose scenes are LIBERO's (128 x 128 here, cut to 116 x 116 as 84 to 76 there).
"""

_base_ = "aloha_sim_diffusion.py"

DATASET = "work_dirs/libero_diffusion/dataset"
HORIZON = 16  # 0.8 s at 20 Hz
STEPS = 100

model = dict(
    state_dim=8, action_dim=7, num_cameras=2, separate_encoders=True, crop_shape=(116, 116)
)

train_dataloader = dict(
    dataset=dict(
        data_root_path=DATASET,
        img_keys=["agentview", "robot0_eye_in_hand"],
        transforms=[
            dict(type="ResizeImages", height=128, width=128),
            dict(type="SimpleNormalizeImages"),
            dict(
                type="NormalizeStatesAndActions",
                state_key="proprio",
                action_key="action",
                norm_type="min_max",
                std_floor=0.01,
            ),
            dict(type="SampleDiffusionNoise", num_train_timesteps=STEPS),
        ],
    )
)

eval = dict(
    _delete_=True,
    type="LiberoEvalRunner",
    task_suite_name="libero_object",
    tasks=[0],
    seed=7,
    num_trials_per_task=50,
    eval_chunk_size=HORIZON // 2,
)

inference = dict(
    _delete_=True,
    type="LiberoInferenceRunner",
    task_suite_name="libero_object",
    seed=7,
    eval_chunk_size=HORIZON // 2,
)
