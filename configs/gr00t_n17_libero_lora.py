"""GR00T N1.7 on LIBERO-Object by adapters in its action head; see ``gr00t_n17_libero.py``.

fluxvla run --config configs/gr00t_n17_libero_lora.py --section runner --nproc 8

Rank 64 and alpha 128 are those that NVIDIA advises for N1.5 (Isaac-GR00T, scripts/gr00t_finetune.py
with its README), with the dropout of that script; queries, keys and values get one.
"""

_base_ = "gr00t_n17_libero.py"

runner = dict(
    lora=dict(
        rank=64,
        alpha=128,
        dropout=0.1,
        target_modules=(
            r"vla_head\.(dit\.blocks|context_blocks)\.\d+\.attention\.(query|key|value)"
        ),
    ),
)
