"""LlavaVLA on ALOHA with frozen backbones: projector and head alone; see ``llava_aloha.py``.

fluxvla run --config configs/llava_aloha_frozen.py --section runner --nproc 8

LLaVA's first stage, which trains the projector alone, at its rate (Liu et al. 2024, and
haotian-liu/LLaVA, scripts/v1_5/pretrain.sh: 1e-3, there with 256 samples a step).
"""

_base_ = "llava_aloha.py"

model = dict(freeze_llm_backbone=True)

runner = dict(learning_rate=1e-3)
