"""LlavaVLA on ALOHA by adapters in the language model; see ``llava_aloha.py``.

fluxvla run --config configs/llava_aloha_lora.py --section runner --nproc 8

Rank 128, alpha 256 and 2e-4 are those of LLaVA 1.5 (scripts/v1_5/finetune_lora.sh), in every linear
layer of the language model. Projector and action head, which is new, are trained as a whole, the
projector there at 2e-5.
"""

_base_ = "llava_aloha.py"

runner = dict(
    learning_rate=2e-4,
    lora=dict(
        rank=128,
        alpha=256,
        dropout=0.05,
        target_modules=(
            r"llm_backbone\.model\.layers\.\d+"
            r"\.(self_attn\.[qkvo]_proj|mlp\.(gate|up|down)_proj)"
        ),
        modules_to_save=["projector", "vla_head"],
    ),
)
