"""Operators that know that their robot over ROS 2 is simulated: episodes, outcomes, clocks."""

from __future__ import annotations

import time

import numpy as np
import pytest
from fluxvla_sim.aloha.arms import HOME
from fluxvla_sim.ros2 import operators
from fluxvla_sim.ros2.operators import AlohaSimROSOperator, URSimROSOperator

from fluxvla_core.errors import ConfigError, NotReady, Rejected
from fluxvla_core.ros2 import Stale
from fluxvla_core.testing.ros2 import ros_domain

from .simulated import ALOHA, UR, connect, drive, simulate, topics, wait_for

__all__ = ["connect", "ros_domain", "simulate", "topics"]


def frames_of(operator):
    """Frames; a moment in which there is none is forgiven."""
    until = time.monotonic() + 20.0
    while time.monotonic() < until:
        try:
            yield operator.get_frame()
        except Stale:
            time.sleep(0.02)


@pytest.mark.realtime
class TestInSimulation:
    """The operators that know that their robot is simulated."""

    def test_episodes_begin_from_seeds(self, simulate, connect, topics):
        simulate("aloha", "--ros2", "--cameras", "top", "--real-time-factor", "0.5")
        operator = connect(AlohaSimROSOperator, seed=20, real_time_factor=0.5, **ALOHA)
        stale = operator.get_frame()
        operator.begin_episode("pick up the cube with the right arm and hold it", 1)
        frame = operator.get_frame()
        assert operator.facts()["seed"] == 21
        assert (frame.images["top"] != stale.images["top"]).any(), "the cube is elsewhere"
        # Receipt stamps are on the operator's own, slower clock.
        assert 0.0 <= operator.clock.now() - frame.stamps["top"] < 5.0

        operator.send_action(HOME)
        wait_for(lambda: operator.facts()["steps"] > 3)
        # What is received late counts for less the longer the episode is.
        time.sleep(3.0)
        assert (operator.task_success(), operator.task_done()) == (False, False)
        found = operator.episode_facts()
        assert found["real_time_factor"] == 0.5
        assert 0.0 < found["real_time_kept"] < 1.5

        aside = HOME.copy()
        aside[0] = 0.5
        drive(operator, aside, lambda state: np.allclose(state, aside, atol=0.06))
        operator.begin_episode("hand the cube over to the left arm", 0)
        np.testing.assert_allclose(operator.get_frame().state, HOME, atol=0.02)
        assert (operator.facts()["seed"], operator.facts()["steps"]) == (20, 0)
        assert operator.last_action is None, "or a stop would send the arm back there"

    def test_a_new_episode_is_seen_by_the_part_that_does_not_begin_it(self, simulate, connect):
        simulate("aloha", "--ros2", "--cameras", "top")
        divided = {
            divide: connect(lambda d=divide, **a: getattr(AlohaSimROSOperator(**a), d)(), **ALOHA)
            for divide in ("without_commands", "without_cameras")
        }
        cameras, control = divided.values()
        aside = HOME.copy()
        aside[0] = 0.5
        drive(control, aside, lambda state: np.allclose(state, aside, atol=0.06))
        stale = cameras.get_frame()
        control.begin_episode("pick up the cube with the right arm and hold it", 1)

        # In between, it must not say what it still has of the episode before.
        frame = next(frames_of(cameras))
        np.testing.assert_allclose(frame.state, HOME, atol=0.02)
        assert (frame.images["top"] != stale.images["top"]).any(), "the cube is elsewhere"
        assert (control.facts()["seed"], control.task_success()) == (1, False)
        with pytest.raises(Rejected, match="sends no commands"):
            cameras.begin_episode("pick up the cube with the right arm and hold it", 2)

    def test_two_clocks_that_differ_are_refused(self, simulate, connect):
        simulate("aloha", "--ros2", "--cameras", "top")
        with pytest.raises(ConfigError, match=r"runs at 1 of real time, this operator is set to 0"):
            connect(AlohaSimROSOperator, real_time_factor=0.5, **ALOHA)

    def test_a_new_episode_that_nobody_sees_is_not_begun(
        self, simulate, connect, topics, monkeypatch
    ):
        simulate("ur5e", "--ros2", "--cameras", "front")
        operator = connect(URSimROSOperator, **UR)
        operator.begin_episode("pick up the red cube", 4)
        assert operator.task_success() is False
        topics.tell("/sim/fault", "front=freeze")

        def frozen():
            before = operator._stamp("front")
            time.sleep(1.5)  # a simulator that stood still for a moment shows another image by then
            return operator._stamp("front") == before

        wait_for(frozen)
        monkeypatch.setattr(operators, "RESET_S", 3.0)
        with pytest.raises(NotReady, match="the simulator shows nothing of the new episode"):
            operator.begin_episode("pick up the red cube", 5)
