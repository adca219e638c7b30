"""LlavaVLA on a UR with a gripper and two cameras; see ``llava_aloha.py``.

fluxvla run --config configs/llava_ur.py --section runner --nproc 8
fluxvla run --config configs/llava_ur.py --section inference --task 1
"""

_base_ = "llava_aloha.py"

DATASET = "datasets/ur5e_example"
CAMERAS = ["cam_high", "cam_left_wrist"]
HORIZON = 30  # 1 s at 30 Hz

model = dict(
    vision_backbone=dict(num_cameras=len(CAMERAS)),
    vla_head=dict(horizon=HORIZON, action_dim=7, state_dim=7),
)

train_dataloader = dict(
    dataset=dict(data_root_path=DATASET, img_keys=CAMERAS, action_window_size=HORIZON)
)

inference = dict(
    _delete_=True,
    type="URInferenceRunner",
    seed=7,
    task_descriptions={"1": "pick up the red cube"},
    execute_horizon=15,
    operator=dict(type="UROperator"),
)
