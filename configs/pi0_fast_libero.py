"""PI0-FAST on LIBERO-Object, fine-tuned from a published base model.

fluxvla run --config configs/pi0_fast_libero.py --section runner --nproc 8
fluxvla run --config configs/pi0_fast_libero.py --section eval

The weights are LeRobot's ``pi0_fast``, whose folder holds the tokenizer of actions, too: the files
of ``lerobot/fast-action-tokenizer`` in ``fast-action-tokenizer``.
"""

_base_ = "pi0_libero.py"

WEIGHTS = "checkpoints/pi0fast_base"
TOKENIZER = "checkpoints/paligemma-3b-pt-224"
FAST = dict(type="FastTokenizer", model_path=f"{WEIGHTS}/fast-action-tokenizer")
# As openpi's pi0_fast_libero (src/openpi/training/config.py): chunks of 10, 7 numbers each, 180
# tokens; optimizer, schedule and batch are those of pi0_libero.
HORIZON = 10
DIMENSIONS = 7

model = dict(
    _delete_=True,
    type="PI0FAST",
    variant="gemma_2b",
    vision_variant="so400m",
    tokenizer=FAST,
    n_action_steps=HORIZON,
    action_dim=DIMENSIONS,
    max_decoding_steps=96,
    # LeRobot's files have the embedding and the head apart.
    tied_head=False,
    pretrained_name_or_path=WEIGHTS,
)

train_dataloader = dict(
    dataset=dict(
        action_window_size=HORIZON,
        transforms=[
            dict(type="ResizeImagesWithPad", height=224, width=224),
            dict(type="SimpleNormalizeImages"),
            # Quantiles, so that rare extremes do not stretch the range (arXiv 2501.09747).
            dict(
                type="NormalizeStatesAndActions",
                state_key="proprio",
                action_key="action",
                norm_type="quantile",
            ),
            dict(type="PreparePromptWithState", ending=""),
            dict(
                type="ProcessPrompts",
                tokenizer=dict(type="PretrainedTokenizer", model_path=TOKENIZER),
                max_len=84,
            ),
            # Together with the prompt openpi's budget of 180 tokens.
            dict(type="ProcessActionTokens", tokenizer=FAST, max_len=96),
        ],
    ),
)

runner = dict(
    collator=dict(
        type="DictCollator",
        keys=[
            "images",
            "img_masks",
            "lang_tokens",
            "lang_masks",
            "action_tokens",
            "action_token_masks",
            "sample_ids",
        ],
        # The prompt and the action tokens hold what these say.
        meta_keys=[
            "states",
            "actions",
            "action_masks",
            "task_description",
            "prompt",
            "info",
            "stats",
            "timestamp",
        ],
    ),
)
