"""The robots that are simulated here."""

from __future__ import annotations

from collections.abc import Mapping

from fluxvla_sim.aloha.world import ALOHA
from fluxvla_sim.ur.world import UR5E
from fluxvla_sim.world import SimRobot

ROBOTS: Mapping[str, SimRobot] = {robot.name: robot for robot in (ALOHA, UR5E)}
