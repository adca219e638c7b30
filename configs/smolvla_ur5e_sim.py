r"""SmolVLA on a simulated UR5e with two cameras; see ``smolvla_aloha_sim.py``.

fluxvla collect ur5e --out work_dirs/ur5e_sim/dataset --episodes 160 --cameras front wrist \
    --height 240 --width 320 --noise 0.02
fluxvla run --config configs/smolvla_ur5e_sim.py --section runner --nproc 2
fluxvla run --config configs/smolvla_ur5e_sim.py --section eval
"""

_base_ = "smolvla_aloha_sim.py"

model = dict(ori_action_dim=7)

train_dataloader = dict(
    dataset=dict(data_root_path="work_dirs/ur5e_sim/dataset", img_keys=["front", "wrist"])
)

eval = dict(
    _delete_=True,
    type="URSimEvalRunner",
    episodes=20,
    seed=500,  # demonstrations begin at 10000
    replan_every=25,
    baseline=True,
    video_cameras=("front", "wrist"),
)

inference = dict(
    _delete_=True,
    type="URInferenceRunner",
    seed=500,
    task_descriptions={"1": "pick up the red cube"},
    execute_horizon=25,
    max_publish_step=300,
    operator=dict(type="URSimOperator", camera_names=("front", "wrist"), height=240, width=320),
)
