"""PI0 on a UR with a gripper and two cameras; see ``pi0_libero.py``.

fluxvla run --config configs/pi0_ur.py --section runner --nproc 8
fluxvla run --config configs/pi0_ur.py --section inference --task 1
"""

_base_ = "pi0_libero.py"

DATASET = "datasets/ur5e_example"

train_dataloader = dict(
    dataset=dict(data_root_path=DATASET, img_keys=["cam_high", "cam_left_wrist"])
)

eval = None

inference = dict(
    _delete_=True,
    type="URInferenceRunner",
    seed=7,
    task_descriptions={"1": "pick up the red cube"},
    execute_horizon=25,
    operator=dict(type="UROperator"),
)
