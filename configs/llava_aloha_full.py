"""LlavaVLA on ALOHA, trained as a whole: the vision tower, too; see ``llava_aloha.py``.

fluxvla run --config configs/llava_aloha_full.py --section runner --nproc 8

The numbers are those of ``llava_aloha.py``; LLaVA itself keeps the vision tower as it is.
"""

_base_ = "llava_aloha.py"

model = dict(freeze_vision_backbone=False)

train_dataloader = dict(per_device_batch_size=8)

runner = dict(grad_accumulation_steps=2)
