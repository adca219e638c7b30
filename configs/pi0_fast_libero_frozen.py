"""PI0-FAST on LIBERO-Object with a frozen vision tower: the language model alone is trained.

fluxvla run --config configs/pi0_fast_libero_frozen.py --section runner --nproc 8

There is no action expert here: it is the language model that answers with actions. The other
numbers are those of ``pi0_fast_libero.py``.
"""

_base_ = "pi0_fast_libero.py"

model = dict(freeze_vision_backbone=True)
