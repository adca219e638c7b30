"""OpenVLA-OFT+ on ALOHA: chunks of 25 joint targets, three images, FiLM.

    fluxvla openvla-oft models/openvla-7b models/openvla-oft-aloha --robot aloha --action-dim 14 \
        --state-dim 14 --film
    fluxvla run --config configs/openvla_oft_aloha.py --section runner --nproc 8
    fluxvla run --config configs/openvla_oft_aloha.py --section inference --task 1

Hyperparameters are those of the authors' ``ALOHA.md``: 8 GPUs with 4 samples each, 100 000 steps,
the rate a tenth after 50 000; actions at 25 Hz. FiLM lets the instruction modulate what is seen;
its layers (``scale``, ``shift``) are trained as a whole.
"""

_base_ = "openvla_oft_libero.py"

BASE = "models/openvla-oft-aloha"
DATASET = "datasets/aloha_put_into_pot"
HORIZON = 25

model = dict(horizon=HORIZON, action_dim=14, num_images=3, state_dim=14, use_film=True)

train_dataloader = dict(
    per_device_batch_size=4,
    dataset=dict(
        data_root_path=DATASET,
        img_keys=["cam_high", "cam_left_wrist", "cam_right_wrist"],
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

runner = dict(
    init_from=BASE,
    max_steps=100000,
    lr_schedule={"_delete_": True, "0": 5e-4, "0.5": 5e-5},
    lora=dict(modules_to_save=["action_head", "proprio_projector", "scale", "shift"]),
)

eval = None

inference = dict(
    type="AlohaInferenceRunner",
    seed=7,
    task_descriptions={"1": "put the yellow corn into the pot"},
    execute_horizon=HORIZON,
    # A real robot also needs arms="arx_x5" or "piper": connecting is refused without it.
    operator=dict(
        type="AlohaOperator",
        camera_names=("cam_high", "cam_left_wrist", "cam_right_wrist"),
    ),
)
