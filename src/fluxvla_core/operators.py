"""Public API for operators, inference runners and action filters.

An operator connects one kind of robot, which an :class:`EmbodimentSpec` describes; a runner drives
it by a policy. Units are SI; times are seconds on the operator's clock. ``fluxvla_core.ros2`` has
the common parts of ROS 2 operators.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fluxvla_core import _lazy

if TYPE_CHECKING:
    from fluxvla_core.build import RunContext as RunContext
    from fluxvla_core.contracts.frame import STATE as STATE
    from fluxvla_core.contracts.frame import Frame as Frame
    from fluxvla_core.contracts.frame import Observation as Observation
    from fluxvla_core.contracts.policy import Continuation as Continuation
    from fluxvla_core.contracts.policy import Policy as Policy
    from fluxvla_core.contracts.robot import ActionFilter as ActionFilter
    from fluxvla_core.contracts.robot import Clock as Clock
    from fluxvla_core.contracts.robot import Operator as Operator
    from fluxvla_core.contracts.robot import Part as Part
    from fluxvla_core.control.clock import MonotonicClock as MonotonicClock
    from fluxvla_core.control.clock import SimulatedClock as SimulatedClock
    from fluxvla_core.control.filters import LowPass as LowPass
    from fluxvla_core.control.filters import SnapGripper as SnapGripper
    from fluxvla_core.control.filters import WorkspaceBox as WorkspaceBox
    from fluxvla_core.control.safety import SafetySettings as SafetySettings
    from fluxvla_core.robot.recording.trace import EpisodeTrace as EpisodeTrace
    from fluxvla_core.robot.recording.trace import next_folder as next_folder
    from fluxvla_core.robot.runner import BaseInferenceRunner as BaseInferenceRunner
    from fluxvla_core.robot.tasks import Task as Task
    from fluxvla_core.robot.tasks import check_descriptions as check_descriptions
    from fluxvla_core.robot.tasks import task_source as task_source
    from fluxvla_core.robot.tasks import tasks as tasks
    from fluxvla_core.spec import Camera as Camera
    from fluxvla_core.spec import EmbodimentSpec as EmbodimentSpec
    from fluxvla_core.spec import Joint as Joint

__getattr__, __dir__, __all__ = _lazy.attach(__name__)
