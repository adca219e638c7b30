"""PI0.5 on a UR5e with a gripper, fine-tuned from a published base model.

fluxvla run --config configs/pi05_ur.py --section runner --nproc 8
fluxvla run --config configs/pi05_ur.py --section inference --task 1
"""

_base_ = "pi05_aloha.py"

DATASET = "datasets/ur5e_example"
TASKS = {"1": "pick up the red cube"}
JOINTS = 7

model = dict(ori_action_dim=JOINTS)

train_dataloader = dict(
    dataset=dict(data_root_path=DATASET, img_keys=["cam_high", "cam_left_wrist"]),
)

inference = dict(
    _delete_=True,
    type="URInferenceRunner",
    seed=7,
    task_descriptions=TASKS,
    execute_horizon=25,
    operator=dict(type="UROperator"),
)
