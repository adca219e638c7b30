"""OpenVLA fine-tuned by adapters on LIBERO, and evaluated there.

    fluxvla run --config configs/openvla_libero.py --section runner --nproc 8
    fluxvla run --config configs/openvla_libero.py --section eval

``BASE`` is a copy of openvla/openvla-7b, ``DATASET`` a LeRobot dataset of LIBERO's demonstrations
(whose gripper is -1 open, 1 closed). Batch, rate and adapters are those of Kim et al., "OpenVLA"
(2024), appendix E, and of the authors' fine-tuning (openvla/openvla, vla-scripts/finetune.py),
which trains until actions are right 95 % of the time: 50 000 to 80 000 steps.
"""

BASE = "models/openvla-7b"
DATASET = "datasets/libero_spatial"

model = dict(type="OpenVLA", action_dim=7)

train_dataloader = dict(
    per_device_batch_size=16,
    per_device_num_workers=4,
    dataset=dict(
        type="ParquetDataset",
        data_root_path=DATASET,
        img_keys=["image"],
        action_window_size=1,
        transforms=[
            dict(type="ResizeOpenVLAImages", size=224, interpolation="lanczos"),
            dict(type="RandomCropOpenVLAImages", area=0.9),
            dict(type="JitterOpenVLAColors"),
            dict(type="CenterCropOpenVLAImages", area=0.9),
            dict(type="SimpleNormalizeImages"),
            dict(
                type="NormalizeOpenVLA",
                bounds="quantile",
                states=False,
                action_mask=[True] * 6 + [False],
                gripper="libero",
            ),
            dict(
                type="ProcessOpenVLAPrompts",
                tokenizer=dict(type="PretrainedTokenizer", model_path=BASE),
                max_len=64,
            ),
        ],
    ),
)

runner = dict(
    type="DDPTrainRunner",
    init_from=BASE,
    max_steps=80000,
    learning_rate=5e-4,
    weight_decay=0.01,
    max_grad_norm=None,
    save_iter_interval=5000,
    max_keep_ckpts=2,
    seed=7,
    enable_mixed_precision_training=True,
    enable_gradient_checkpointing=True,
    # Every linear layer that is used, as the authors' "all-linear"; rank and alpha are theirs.
    lora=dict(
        rank=32,
        alpha=16,
        target_modules=(
            r"vision_backbone\.featurizer\.blocks\.(\d|1\d|2[0-2])\.(attn\.(qkv|proj)|mlp\.fc[12])"
            r"|vision_backbone\.fused_featurizer\.blocks\.(\d|1\d|2[0-5])"
            r"\.(attn\.(qkv|proj)|mlp\.fc[12])"
            r"|vision_backbone\.(fused_)?featurizer\.patch_embed\.proj"
            r"|projector\.fc[123]"
            r"|language_model\.model\.layers\.\d+\.(self_attn\.[qkvo]_proj|mlp\.(gate|up|down)_proj)"
            r"|language_model\.lm_head"
        ),
    ),
    collator=dict(
        type="DictCollator",
        keys=["images", "actions", "action_masks", "lang_tokens", "lang_masks", "sample_ids"],
        meta_keys=["states", "img_masks", "task_description", "info", "stats", "timestamp"],
    ),
    metric=dict(type="VLAMetric", active_trackers=("jsonl",)),
)

eval = dict(
    type="LiberoEvalRunner",
    task_suite_name="libero_spatial",
    seed=7,
    num_trials_per_task=50,
    eval_chunk_size=1,
    protocol="openvla",
    render="reference",
)
