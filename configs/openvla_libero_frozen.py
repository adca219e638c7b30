"""OpenVLA on LIBERO with frozen vision; see ``openvla_libero_full.py``.

fluxvla run --config configs/openvla_libero_frozen.py --section runner --nproc 8

Kim et al. 2024 (section 5.3) compare this with other ways: it takes less memory than training all,
and does worse, as the towers do not adapt to new scenes.
"""

_base_ = "openvla_libero_full.py"

model = dict(freeze_vision_backbone=True)
