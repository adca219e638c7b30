"""ROS 2 for tests: a domain of their own, drivers in processes of their own."""

from __future__ import annotations

import pytest

from fluxvla_core.testing.ros2 import drivers, lasting_drivers, other_domain, ros_domain
from tests.ros2.arm import Arm

__all__ = ["drivers", "lasting_drivers", "operators", "other_domain", "ros_domain"]


@pytest.fixture
def operators(ros_domain):
    made = []

    def make(**settings):
        made.append(Arm(**settings))
        return made[-1]

    yield make
    for operator in made:
        operator.close()
