"""PI0 on LIBERO-Object by adapters, in the language model and the action expert.

fluxvla run --config configs/pi0_libero_lora.py --section runner --nproc 8

openpi's low-memory recipe (src/openpi/models/gemma.py and src/openpi/training/config.py): adapters
in attention and feed-forward layers, alpha as large as the rank, no averaged weights. There the
language model has rank 16 and the expert 32, and the vision tower is trained as a whole; here all
have rank 16, and the tower stays as it is. The layers that states, actions and times pass are
trained as a whole.
"""

_base_ = "pi0_libero.py"

runner = dict(
    ema_decay=None,
    lora=dict(
        rank=16,
        alpha=16,
        target_modules=(
            r"(llm_expert\.layers\.\d+|llm_backbone\.layers\.(\d|1[0-6]))"
            r"\.(self_attn\.[qkvo]_proj|mlp\.(gate|up|down)_proj)"
            # Of the language model's last layer, only keys and values are used.
            r"|llm_backbone\.layers\.17\.self_attn\.[kv]_proj"
        ),
        modules_to_save=[
            "action_in_proj",
            "action_out_proj",
            "action_time_mlp_in",
            "action_time_mlp_out",
            "state_proj",
        ],
    ),
)
