"""GR00T N1.7 on LIBERO-Object by adapters in its action head; see ``gr00t_n17_libero.py``.

fluxvla run --config configs/gr00t_n17_libero_lora.py --section runner --nproc 8

Rank 64 and alpha 128 are those that NVIDIA names for N1.5 (NVIDIA/Isaac-GR00T, README.md, which
advises to train the head as a whole instead), with the dropout of its scripts/gr00t_finetune.py;
queries, keys and values get one.
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
