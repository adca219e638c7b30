"""The policy of ``aloha_sim_transfer.py`` on an ALOHA behind ROS 2 topics.

In one terminal the robot, here a simulated one:

    fluxvla sim aloha --ros2 --cameras top --height 144 --width 192

and in another the policy, from the work dir that the training made:

    fluxvla run --config configs/aloha_sim_ros2.py --section inference --task 1 \
        --work-dir work_dirs/aloha_sim_transfer

On a real robot only the topics differ: ``preset`` has them for AgileX and for Interbotix.
"""

_base_ = "aloha_sim_transfer.py"

inference = dict(
    operator=dict(
        _delete_=True,
        type="AlohaOperator",
        preset="cobot_magic",
        camera_names=("top",),
        height=144,
        width=192,
    ),
)
