"""PI0.5 on ALOHA with a frozen backbone: the action expert alone is trained.

fluxvla run --config configs/pi05_aloha_frozen.py --section runner --nproc 8

What LeRobot calls ``train_expert_only``: the vision tower and the language model keep their
weights, and no gradient passes them. The other numbers are those of ``pi05_aloha.py``.
"""

_base_ = "pi05_aloha.py"

model = dict(freeze_vision_backbone=True, freeze_llm_backbone=True)
