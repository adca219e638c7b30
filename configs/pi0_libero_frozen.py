"""PI0 on LIBERO-Object with a frozen backbone: the action expert alone is trained.

fluxvla run --config configs/pi0_libero_frozen.py --section runner --nproc 8

What LeRobot calls ``train_expert_only``: the vision tower and the language model keep their
weights, and no gradient passes them. The other numbers are those of ``pi0_libero.py``.
"""

_base_ = "pi0_libero.py"

model = dict(freeze_vision_backbone=True, freeze_llm_backbone=True)
