"""The policy of ``ur5e_sim_lift.py`` on a simulated UR5e behind ur_robot_driver's ROS 2 topics.

In one terminal the robot:

    fluxvla sim ur5e --ros2 --height 96 --width 128

and in another the policy, from the work dir that the training made; with ``--section eval`` over
20 cube positions:

    fluxvla run --config configs/ur5e_sim_ros2.py --section inference --task 1 \
        --work-dir work_dirs/ur5e_sim_lift

On a real robot ``operator.type`` is ``UROperator``; its ``model`` is a UR5e by default.
"""

_base_ = "ur5e_sim_lift.py"

inference = dict(
    # 8 s at the 125 commands a second that UROperator sends.
    max_publish_step=1000,
    operator=dict(type="URSimROSOperator"),
)

eval = dict(
    _delete_=True,
    type="RobotEvalRunner",
    tasks=dict(lift_cube="1"),
    episodes=20,
    seed=500,
    go_on=True,  # nobody can be hurt
)
