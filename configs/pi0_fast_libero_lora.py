"""PI0-FAST on LIBERO-Object by adapters in the language model.

fluxvla run --config configs/pi0_fast_libero_lora.py --section runner --nproc 8

openpi's low-memory recipe (src/openpi/models/gemma.py and src/openpi/training/config.py): adapters
of rank 16 in attention and feed-forward layers, alpha as large as the rank, no averaged weights.
There the vision tower is trained as a whole; here it stays as it is.
"""

_base_ = "pi0_fast_libero.py"

runner = dict(
    ema_decay=None,
    lora=dict(
        rank=16,
        alpha=16,
        target_modules=(
            r"llm_backbone\.layers\.\d+\.(self_attn\.[qkvo]_proj|mlp\.(gate|up|down)_proj)"
        ),
    ),
)
