"""PI0 on LIBERO-Object, fine-tuned from a published base model.

fluxvla run --config configs/pi0_libero.py --section runner --nproc 8
fluxvla run --config configs/pi0_libero.py --section eval

openpi's ``pi0_libero`` (src/openpi/training/config.py): chunks of 50 actions, 32 samples a step
(with 8 processes), the rest as in ``pi05_aloha.py``; 5 actions of a chunk are executed
(examples/libero/main.py). It has ``extra_delta_transform``, which takes the state from actions that
are differences already; this does not.
"""

_base_ = "pi05_aloha.py"

WEIGHTS = "checkpoints/pi0_base"
TOKENIZER = "checkpoints/paligemma-3b-pt-224"
DATASET = "datasets/libero_object"
HORIZON = 50

model = dict(
    _delete_=True,
    type="PI0FlowMatching",
    variant="gemma_2b",
    expert_variant="gemma_300m",
    vision_variant="so400m",
    n_action_steps=HORIZON,
    max_action_dim=32,
    max_state_dim=32,
    ori_action_dim=7,
    pretrained_name_or_path=WEIGHTS,
)

train_dataloader = dict(
    per_device_batch_size=4,
    dataset=dict(
        data_root_path=DATASET,
        img_keys=["agentview", "robot0_eye_in_hand"],
        action_window_size=HORIZON,
        transforms=[
            dict(type="ResizeImagesWithPad", height=224, width=224),
            dict(type="SimpleNormalizeImages"),
            # PI0's states are a token: padded, and normalised by mean and standard deviation.
            dict(
                type="NormalizeStatesAndActions",
                state_key="proprio",
                action_key="action",
                norm_type="mean_std",
                state_dim=32,
                action_dim=32,
            ),
            dict(type="PreparePrompt"),
            dict(
                type="ProcessPrompts",
                tokenizer=dict(type="PretrainedTokenizer", model_path=TOKENIZER),
                max_len=48,
            ),
            dict(type="SampleFlowNoise", repeats=1, distribution="beta", alpha=1.5, beta=1.0),
        ],
    ),
)

eval = dict(
    type="LiberoEvalRunner",
    task_suite_name="libero_object",
    seed=7,
    num_trials_per_task=50,
    eval_chunk_size=5,
)

inference = dict(
    _delete_=True,
    type="LiberoInferenceRunner",
    task_suite_name="libero_object",
    seed=7,
    eval_chunk_size=5,
)
