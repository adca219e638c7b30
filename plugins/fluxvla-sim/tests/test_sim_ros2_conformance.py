"""Simulated robots behind ROS 2 topics do what every operator must."""

from __future__ import annotations

import subprocess
import sys
from typing import ClassVar

import pytest

from fluxvla_core.testing import OperatorConformance
from fluxvla_core.testing.ros2 import ros_domain

__all__ = ["ros_domain"]

SMALL = ["--height", "48", "--width", "64", "--camera-hz", "20"]
_END_S = 60.0
# Machines that run tests stall for seconds.
PATIENT = {
    "height": 48,
    "width": 64,
    "connect_timeout_s": 60.0,
    "max_age_s": 20.0,
    "max_skew_s": 1.0,
    "rate_window_s": 0.0,
}


class OverRos2(OperatorConformance):
    """With ``fluxvla sim`` in a process of its own."""

    words: tuple[str, ...]
    ready_within_s = 60.0

    @pytest.fixture(scope="class", autouse=True)
    @classmethod
    def simulation(cls, ros_domain):
        run = "import sys; from fluxvla_core.cli.main import main; sys.exit(main())"
        words = [sys.executable, "-c", run, "sim", *cls.words, "--ros2", *SMALL]
        with subprocess.Popen(words, stdout=subprocess.DEVNULL) as process:
            yield
            process.terminate()
            try:
                process.wait(_END_S)
            finally:
                process.kill()


class TestAlohaSimROSOperator(OverRos2):
    entry_point = "AlohaSimROSOperator"
    words = ("aloha", "--cameras", "top")
    arguments: ClassVar = {"camera_names": ("top",), **PATIENT}


class TestURSimROSOperator(OverRos2):
    entry_point = "URSimROSOperator"
    words = ("ur5e", "--cameras", "front")
    arguments: ClassVar = {"camera_names": ("front",), **PATIENT}
