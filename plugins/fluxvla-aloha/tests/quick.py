"""Options of ALOHA operators in tests: the specification's, and small images and short waits."""

SMALL = {"height": 48, "width": 64}
QUICK = {
    **SMALL,
    "arms": "viperx300",
    "rate_window_s": 0.0,
    "connect_timeout_s": 8.0,
    # Machines that run tests stall for a second; what is silent for longer is silent.
    "max_age_s": 2.0,
}
SPECIFICATION = {
    # The operator of the specification's Aloha config, word for word.
    "type": "AlohaOperator",
    "img_front_topic": "/camera_f/color/image_raw",
    "img_left_topic": "/camera_l/color/image_raw",
    "img_right_topic": "/camera_r/color/image_raw",
    "img_front_depth_topic": "/camera_f/depth/image_raw",
    "img_left_depth_topic": "/camera_l/depth/image_raw",
    "img_right_depth_topic": "/camera_r/depth/image_raw",
    "puppet_arm_left_cmd_topic": "/master/joint_left",
    "puppet_arm_right_cmd_topic": "/master/joint_right",
    "puppet_arm_left_topic": "/puppet/joint_left",
    "puppet_arm_right_topic": "/puppet/joint_right",
    "robot_base_topic": "/odom_raw",
    "robot_base_cmd_topic": "/cmd_vel",
}
