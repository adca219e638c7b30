"""Evaluate the policy of fluxvla-myrobot in a simulation of one's own.

fluxvla run --config configs/mysim.py --section eval
"""

_base_ = "../../fluxvla-myrobot/configs/myrobot.py"

eval = dict(
    type="MySimEvalRunner",
    task_suite_name="my_benchmark",
    seed=7,
    ckpt_path="work_dirs/myrobot",
    dataset=None,
    denormalize_action=dict(
        type="DenormalizePrivateAction", norm_type="mean_std", std_floor=0.05, action_dim=7
    ),
    results="work_dirs/myrobot/my_benchmark.json",
)
