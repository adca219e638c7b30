"""SmolVLA on a simulated ALOHA, trained on from LeRobot's base model.

fluxvla collect aloha --out work_dirs/aloha_sim/dataset --episodes 240
fluxvla run --config configs/smolvla_aloha_sim.py --section runner --nproc 2
fluxvla run --config configs/smolvla_aloha_sim.py --section eval
fluxvla run --config configs/smolvla_aloha_sim.py --section inference --task 1

The weights are fetched from the hub (``pip install 'fluxvla-core[hub]'``), or name the folder:
``--set model.pretrained_name_or_path=FOLDER``. TOKENIZER is a folder with ``tokenizer.json`` and
``tokenizer_config.json`` of HuggingFaceTB/SmolVLM2-500M-Video-Instruct.
"""

_base_ = "aloha_sim_transfer.py"

TOKENIZER = "work_dirs/smolvla/tokenizer"
HORIZON = 50

model = dict(
    _delete_=True,
    type="SmolVLA",
    pretrained_name_or_path="hf:lerobot/smolvla_base",
    n_action_steps=HORIZON,
    ori_action_dim=14,
    # By default the expert and the projections alone are trained, as in the paper. Everything:
    # freeze_vision_encoder=False, train_expert_only=False
)

train_dataloader = dict(
    per_device_batch_size=32,
    dataset=dict(
        action_window_size=HORIZON,
        per_step_statistics=False,
        transforms=[
            dict(type="SmolVLAImages"),
            dict(type="SmolVLANormalize"),
            dict(type="SmolVLAPrompt"),
            dict(
                type="ProcessPrompts",
                tokenizer=dict(type="PretrainedTokenizer", model_path=TOKENIZER),
                max_len=48,
            ),
            # One draw of noise a sample, times by Beta(1.5, 1): as pi0 and the paper.
            dict(type="SampleFlowNoise", repeats=1, distribution="beta", alpha=1.5, beta=1.0),
        ],
    ),
)

# Shukor et al. 2025 (arXiv 2506.01844) and LeRobot 0.6.1 (src/lerobot/policies/smolvla/
# configuration_smolvla.py): batches of 64 (with 2 processes), AdamW with betas of 0.9 and 0.95,
# weight decay 1e-10, clipping at 10, 1000 steps of warm-up to 1e-4, a cosine over 30 000 steps.
# LeRobot's ends at 2.5e-6, this one at 0.
runner = dict(
    max_steps=30000,
    learning_rate=1e-4,
    optimizer=dict(type="AdamW", betas=(0.9, 0.95), eps=1e-8),
    weight_decay=1e-10,
    max_grad_norm=10.0,
    warmup_ratio=1000 / 30000,
    ema_decay=None,
    save_iter_interval=5000,
    enable_mixed_precision_training=True,
    collator=dict(
        keys=[
            "images",
            "img_masks",
            "states",
            "actions",
            "action_masks",
            "lang_tokens",
            "lang_masks",
            "noise",
            "time",
            "sample_ids",
        ],
        meta_keys=["task_description", "prompt", "info", "stats", "timestamp"],
    ),
)

eval = dict(replan_every=25)

inference = dict(execute_horizon=25)
