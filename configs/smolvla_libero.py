r"""SmolVLA on LIBERO-Object; see ``smolvla_aloha_sim.py``.

    pip install 'fluxvla-libero[libero]'
    fluxvla data collect --env LiberoEnvironment --out work_dirs/libero_object/dataset \
        --episodes 144 --cameras agentview robot0_eye_in_hand --height 256 \
        --width 256 --set 'env.tasks=[0, 2, 4]'
    fluxvla run --config configs/smolvla_libero.py --section runner --nproc 2
    fluxvla run --config configs/smolvla_libero.py --section eval
"""

_base_ = "smolvla_aloha_sim.py"

model = dict(ori_action_dim=7)

train_dataloader = dict(
    dataset=dict(
        data_root_path="work_dirs/libero_object/dataset",
        img_keys=["agentview", "robot0_eye_in_hand"],
    )
)

runner = dict(max_steps=100000, warmup_ratio=1000 / 100000)  # as the paper on simulated benchmarks

eval = dict(
    _delete_=True,
    type="LiberoEvalRunner",
    task_suite_name="libero_object",
    tasks=[0, 2, 4],
    seed=7,
    num_trials_per_task=50,
    eval_chunk_size=10,
    instruction_swap=True,
)

inference = dict(
    _delete_=True,
    type="LiberoInferenceRunner",
    task_suite_name="libero_object",
    seed=7,
    eval_chunk_size=10,
)
