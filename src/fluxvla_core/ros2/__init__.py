"""What every ROS 2 operator needs: one connection, typed streams, messages as arrays, safe stops.

``rclpy`` and message packages are imported when an operator connects, never before: a config can be
checked, and an operator built and described, on a machine without ROS. Only what ROS 2 Humble's
rclpy has is used, so the same code runs on Humble, Jazzy and Kilted.
"""
