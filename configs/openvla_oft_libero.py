"""OpenVLA-OFT on LIBERO: chunks of 8 actions by L1 regression, two images and the state.

    fluxvla openvla-oft models/openvla-7b models/openvla-oft-libero --robot libero
    fluxvla run --config configs/openvla_oft_libero.py --section runner --nproc 8
    fluxvla run --config configs/openvla_oft_libero.py --section eval

Hyperparameters are those of Kim, Finn, Liang, "Fine-Tuning Vision-Language-Action Models" (2025),
appendix, and of the authors' ``LIBERO.md`` (moojink/openvla-oft): 8 GPUs with 8 samples each,
150 000 steps, the rate a tenth after 100 000.
"""

_base_ = "openvla_libero.py"

BASE = "models/openvla-oft-libero"
HORIZON = 8

model = dict(
    _delete_=True,
    type="OpenVLAOFT",
    horizon=HORIZON,
    action_dim=7,
    num_images=2,
    state_dim=8,
    head="l1",
)

train_dataloader = dict(
    per_device_batch_size=8,
    dataset=dict(
        img_keys=["image", "wrist_image"],
        action_window_size=HORIZON,
        transforms=[
            dict(type="ResizeOpenVLAImages", size=224, interpolation="lanczos"),
            dict(type="RandomCropOpenVLAImages", area=0.9),
            dict(type="JitterOpenVLAColors"),
            dict(type="CenterCropOpenVLAImages", area=0.9),
            dict(type="SimpleNormalizeImages"),
            dict(
                type="NormalizeOpenVLA",
                bounds="quantile",
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
    init_from=BASE,
    max_steps=150000,
    lr_scheduler_type="step-based",
    lr_schedule={"0": 5e-4, "0.6666667": 5e-5},
    save_iter_interval=10000,
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
        ),
        modules_to_save=["action_head", "proprio_projector"],
    ),
    collator=dict(
        keys=[
            "images",
            "states",
            "actions",
            "action_masks",
            "lang_tokens",
            "lang_masks",
            "sample_ids",
        ],
        meta_keys=["img_masks", "task_description", "info", "stats", "timestamp"],
    ),
)

eval = dict(eval_chunk_size=HORIZON)
