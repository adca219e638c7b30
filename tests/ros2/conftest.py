"""ROS 2 for tests: a domain of their own, drivers in processes of their own."""

from fluxvla_core.testing.ros2 import drivers, ros_domain

__all__ = ["drivers", "ros_domain"]
