"""OpenVLA fine-tuned by adapters on ALOHA, by one camera; see ``openvla_libero.py``.

fluxvla run --config configs/openvla_aloha.py --section runner --nproc 8
fluxvla run --config configs/openvla_aloha.py --section inference --task 1

OpenVLA answers with one action, token by token: record the demonstrations at the rate that it
reaches on your GPU (the paper: 6 Hz on an RTX 4090), half of that for two arms, or take
OpenVLA-OFT (``openvla_oft_aloha.py``).
"""

_base_ = "openvla_libero.py"

BASE = "models/openvla-7b"
DATASET = "datasets/aloha_example"

model = dict(action_dim=14)

train_dataloader = dict(
    dataset=dict(
        data_root_path=DATASET,
        img_keys=["cam_high"],
        transforms=[
            dict(type="ResizeOpenVLAImages", size=224, interpolation="lanczos"),
            dict(type="RandomCropOpenVLAImages", area=0.9),
            dict(type="JitterOpenVLAColors"),
            dict(type="CenterCropOpenVLAImages", area=0.9),
            dict(type="SimpleNormalizeImages"),
            dict(type="NormalizeOpenVLA", bounds="quantile", states=False),
            dict(
                type="ProcessOpenVLAPrompts",
                tokenizer=dict(type="PretrainedTokenizer", model_path=BASE),
                max_len=64,
            ),
        ],
    )
)

eval = None

inference = dict(
    type="AlohaInferenceRunner",
    seed=7,
    task_descriptions={"1": "put the red cube into the box"},
    # A real robot also needs arms="arx_x5" or "piper": connecting is refused without it.
    operator=dict(type="AlohaOperator", camera_names=("cam_high",)),
)
