r"""LIBERO-Object, one task, by ACT, which reads no instructions; see ``aloha_sim_act.py``.

    fluxvla data collect --env LiberoEnvironment --out work_dirs/libero_act/dataset \
        --episodes 50 --cameras agentview robot0_eye_in_hand --height 128 --width 128 \
        --set 'env.tasks=[0]'
    fluxvla run --config configs/libero_act.py --section runner
    fluxvla run --config configs/libero_act.py --section eval

Hyperparameters are those of the paper, which has no LIBERO: two seconds are a chunk there, too.
"""

_base_ = "aloha_sim_act.py"

DATASET = "work_dirs/libero_act/dataset"
HORIZON = 40  # 2 s at 20 Hz

model = dict(state_dim=8, action_dim=7, horizon=HORIZON, num_cameras=2)

train_dataloader = dict(
    dataset=dict(
        data_root_path=DATASET,
        img_keys=["agentview", "robot0_eye_in_hand"],
        action_window_size=HORIZON,
        transforms=[
            dict(type="ResizeImages", height=128, width=128),
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
