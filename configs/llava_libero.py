"""LlavaVLA on LIBERO-Object with two cameras; see ``llava_aloha.py``.

fluxvla run --config configs/llava_libero.py --section runner --nproc 8
fluxvla run --config configs/llava_libero.py --section eval
"""

_base_ = "llava_aloha.py"

DATASET = "datasets/libero_object"
CAMERAS = ["agentview", "robot0_eye_in_hand"]
HORIZON = 16  # 0.8 s at 20 Hz

model = dict(
    vision_backbone=dict(num_cameras=len(CAMERAS)),
    vla_head=dict(horizon=HORIZON, action_dim=7, state_dim=8),
)

train_dataloader = dict(
    dataset=dict(data_root_path=DATASET, img_keys=CAMERAS, action_window_size=HORIZON)
)

eval = dict(
    type="LiberoEvalRunner",
    task_suite_name="libero_object",
    tasks=[0, 2, 4],
    seed=7,
    num_trials_per_task=50,
    eval_chunk_size=8,
    instruction_swap=True,
)

inference = dict(
    _delete_=True,
    type="LiberoInferenceRunner",
    task_suite_name="libero_object",
    seed=7,
    eval_chunk_size=8,
)
