"""SmolVLA on LIBERO-Object by adapters in the action expert; see ``smolvla_libero.py``.

fluxvla run --config configs/smolvla_libero_lora.py --section runner --nproc 2

LeRobot's defaults for SmolVLA (modeling_smolvla.py: queries and values of the expert, and the
projections of states, actions and times) with rank, alpha and rate of its guide to adapters
(docs/source/peft_training.mdx of its repository): 64, 64 and 1e-3, ten times that of full
fine-tuning.
"""

_base_ = "smolvla_libero.py"

runner = dict(
    learning_rate=1e-3,
    lora=dict(
        rank=64,
        alpha=64,
        target_modules=(
            r"expert\.layers\.\d+\.self_attn\.[qv]_proj|state_proj|action_out_proj"
            r"|embed_actions\.(action_in_proj|action_time_mlp_(in|out))"
        ),
    ),
)
