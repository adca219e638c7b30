"""OpenVLA-OFT on LIBERO with a frozen backbone: projectors and action head alone are trained.

fluxvla run --config configs/openvla_oft_libero_frozen.py --section runner --nproc 8

The head of Kim, Finn, Liang (2025) on what a trained OpenVLA sees and reads; rate and schedule are
theirs, the paper does not try it. See ``openvla_oft_libero.py``.
"""

_base_ = "openvla_oft_libero.py"

model = dict(freeze_vision_backbone=True, freeze_llm_backbone=True)

runner = dict(lora=None)
