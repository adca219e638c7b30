"""The policy of ``aloha_sim_transfer.py`` on a simulated ALOHA behind the real one's ROS 2 topics.

In one terminal the robot:

    fluxvla sim aloha --ros2 --cameras top --height 144 --width 192

and in another the policy, from the work dir of the training (here the demo's):

    fluxvla run --config configs/aloha_sim_ros2.py --section inference --task 1 \
        --work-dir demo_out/default/work

How often it succeeds, over as many cube positions, in real time:

    fluxvla run --config configs/aloha_sim_ros2.py --section eval \
        --work-dir demo_out/default/work

On a machine that cannot simulate and think in real time, ``--real-time-factor 0.5`` there and
``--set inference.operator.real_time_factor=0.5`` here slow both down alike. On a real robot
``operator.type`` is ``AlohaOperator``: its ``preset`` has the topics of AgileX (the default) or of
Interbotix, ``arms`` the limits.
"""

_base_ = "aloha_sim_transfer.py"

inference = dict(
    # A real robot does not wait: what became of the chunk's last actions is seen before they end.
    max_publish_step=400,
    operator=dict(type="AlohaSimROSOperator"),
)

eval = dict(
    _delete_=True,
    type="RobotEvalRunner",
    tasks=dict(lift_hold="1", transfer_cube="2"),
    episodes=20,
    seed=500,
    go_on=True,  # nobody can be hurt
)
