"""GR00T N1.5 on ALOHA, trained as a whole: the backbone too; see ``gr00t_n15_aloha.py``.

fluxvla run --config configs/gr00t_n15_aloha_full.py --section runner --nproc 8

NVIDIA's ``--tune-llm --tune-visual``, with the numbers of its fine-tuning of the head.
"""

_base_ = "gr00t_n15_aloha.py"

model = dict(freeze_vlm_backbone=False)

train_dataloader = dict(per_device_batch_size=8)

runner = dict(grad_accumulation_steps=4, enable_gradient_checkpointing=True)
