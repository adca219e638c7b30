r"""A simulated UR5e picks up a cube by Diffusion Policy; see ``aloha_sim_diffusion.py``.

fluxvla collect ur5e --out work_dirs/ur5e_sim_diffusion/dataset --episodes 200 \
    --cameras front wrist --height 240 --width 320 --noise 0.02
fluxvla run --config configs/ur5e_sim_diffusion.py --section runner
fluxvla run --config configs/ur5e_sim_diffusion.py --section eval
fluxvla run --config configs/ur5e_sim_diffusion.py --section inference --task 1

The paper has a UR5 of its own (Push-T, 10 Hz): images of 240 x 320 cut to 216 x 288, an encoder
for each camera.
"""

_base_ = "aloha_sim_diffusion.py"

DATASET = "work_dirs/ur5e_sim_diffusion/dataset"
HORIZON = 16  # 1.6 s at 10 Hz
STEPS = 100

model = dict(
    state_dim=7, action_dim=7, num_cameras=2, separate_encoders=True, crop_shape=(216, 288)
)

train_dataloader = dict(
    dataset=dict(
        data_root_path=DATASET,
        img_keys=["front", "wrist"],
        transforms=[
            dict(type="ResizeImages", height=240, width=320),
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
    type="URSimEvalRunner",
    episodes=50,
    seed=500,  # demonstrations begin at 10000
    replan_every=HORIZON // 2,
    video_cameras=("front", "wrist"),
)

inference = dict(
    _delete_=True,
    type="URInferenceRunner",
    seed=500,
    task_descriptions={"1": "pick up the red cube"},
    execute_horizon=HORIZON // 2,
    max_publish_step=300,
    # UROperator is the real one; it sends 125 commands a second: a larger max_publish_step.
    operator=dict(type="URSimOperator", camera_names=("front", "wrist"), height=240, width=320),
)
