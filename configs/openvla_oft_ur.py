"""OpenVLA-OFT on a UR with one gripper: chunks of 10 joint targets, two images and the state.

    fluxvla openvla-oft models/openvla-7b models/openvla-oft-ur --robot aloha --horizon 10 \
        --cameras 2 --action-dim 7 --state-dim 7
    fluxvla run --config configs/openvla_oft_ur.py --section runner --nproc 8
    fluxvla run --config configs/openvla_oft_ur.py --section inference --task 1

Neither paper has a UR: joint targets are scaled by minimum and maximum, as for ALOHA, and the rest
is as for LIBERO. A chunk of 10 fits data at 10 Hz; let it be about a second of the dataset's.
"""

_base_ = "openvla_oft_libero.py"

BASE = "models/openvla-oft-ur"
DATASET = "datasets/ur5e_lift"
HORIZON = 10

model = dict(horizon=HORIZON, action_dim=7, state_dim=7)

train_dataloader = dict(
    dataset=dict(
        data_root_path=DATASET,
        img_keys=["front", "wrist"],
        action_window_size=HORIZON,
        transforms=[
            dict(type="ResizeOpenVLAImages", size=224, interpolation="lanczos"),
            dict(type="RandomCropOpenVLAImages", area=0.9),
            dict(type="JitterOpenVLAColors"),
            dict(type="CenterCropOpenVLAImages", area=0.9),
            dict(type="SimpleNormalizeImages"),
            dict(type="NormalizeOpenVLA", bounds="min_max"),
            dict(
                type="ProcessOpenVLAPrompts",
                tokenizer=dict(type="PretrainedTokenizer", model_path=BASE),
                max_len=64,
            ),
        ],
    ),
)

runner = dict(init_from=BASE)

eval = None

inference = dict(
    type="URInferenceRunner",
    seed=7,
    task_descriptions={"1": "pick up the red cube"},
    execute_horizon=HORIZON,
    operator=dict(type="UROperator", camera_names=("front", "wrist")),
)
