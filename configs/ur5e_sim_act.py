r"""A simulated UR5e picks up a cube by ACT, seen by two cameras; see ``aloha_sim_act.py``.

fluxvla collect ur5e --out work_dirs/ur5e_sim_act/dataset --episodes 50 --fps 50 \
    --cameras front wrist --height 240 --width 320 --noise 0.02
fluxvla run --config configs/ur5e_sim_act.py --section runner
fluxvla run --config configs/ur5e_sim_act.py --section eval
fluxvla run --config configs/ur5e_sim_act.py --section inference --task 1

Hyperparameters are those of the paper, which has no UR: two seconds are a chunk there, too.
"""

_base_ = "aloha_sim_act.py"

DATASET = "work_dirs/ur5e_sim_act/dataset"
HORIZON = 100  # 2 s at 50 Hz

model = dict(state_dim=7, action_dim=7, num_cameras=2)

train_dataloader = dict(
    dataset=dict(
        data_root_path=DATASET,
        img_keys=["front", "wrist"],
        transforms=[
            dict(type="ResizeImages", height=240, width=320),
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
    )
)

eval = dict(
    _delete_=True,
    type="URSimEvalRunner",
    episodes=50,
    seed=500,  # demonstrations begin at 10000
    replan_every=HORIZON,
    video_cameras=("front", "wrist"),
)

inference = dict(
    _delete_=True,
    type="URInferenceRunner",
    seed=500,
    task_descriptions={"1": "pick up the red cube"},
    chunk_joining=dict(method="temporal_ensemble", coefficient=0.01),
    max_publish_step=300,
    # UROperator is the real one; it sends 125 commands a second: a larger max_publish_step.
    operator=dict(type="URSimOperator", camera_names=("front", "wrist"), height=240, width=320),
)
