"""PI0 on ALOHA, fine-tuned from a published base model; see ``pi0_libero.py``.

fluxvla run --config configs/pi0_aloha.py --section runner --nproc 8
fluxvla run --config configs/pi0_aloha.py --section inference --task 1

Chunks of 50 actions are one second of ALOHA's, as the model was trained (arXiv 2410.24164).
"""

_base_ = "pi0_libero.py"

DATASET = "datasets/aloha_example"

model = dict(ori_action_dim=14)

train_dataloader = dict(
    dataset=dict(
        data_root_path=DATASET,
        img_keys=["cam_high", "cam_left_wrist", "cam_right_wrist"],
    )
)

eval = None

inference = dict(
    _delete_=True,
    type="AlohaInferenceRunner",
    seed=7,
    task_descriptions={"1": "put the red cube into the box"},
    execute_horizon=25,
    # A real robot also needs arms="arx_x5" or "piper": connecting is refused without it.
    operator=dict(type="AlohaOperator"),
)
