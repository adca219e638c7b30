"""Operators for robots that ``fluxvla sim`` simulates behind ROS 2.

``AlohaSimROSOperator`` is ``AlohaOperator``, ``URSimROSOperator`` is ``UROperator``: the same
topics, messages and checks. A simulation can do three things more: begin an episode from a seed,
report whether the task is done, and run slower than real time.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from fluxvla_aloha.operator import AlohaOperator
from fluxvla_ur.operator import UROperator

from fluxvla_core.errors import ConfigError, NotReady
from fluxvla_core.operators import MonotonicClock
from fluxvla_core.ros2 import (
    AUXILIARY,
    CAMERA,
    STATE,
    CommandSpec,
    Connection,
    RobotFrame,
    RosOperator,
    Stale,
    StreamSpec,
    message_class,
)
from fluxvla_sim.operators import check_arms

log = logging.getLogger("fluxvla.sim")

FACTS, RESET = "/sim/facts", "/sim/reset"
STRING, INT64 = "std_msgs.msg:String", "std_msgs.msg:Int64"
RESET_S = 10.0
"""How long a simulator may take to begin an episode, in its own seconds."""
_POLL_S = 0.01
_SETTLE_S = 0.2
_KEPT = 0.95


class SlowedClock:
    """The monotonic clock at ``factor`` of its speed: what is a second here takes 1 / factor.

    A control loop that lives by it sends 50 commands in a simulated second, whatever that takes;
    its deadlines, watchdogs and latencies are all in the robot's time. A policy so has more time to
    think than on a real robot: results must state the factor.
    """

    lockstep = False

    def __init__(self, factor: float) -> None:
        self.factor = factor

    def now(self) -> float:
        return time.monotonic() * self.factor

    def sleep_until(self, deadline: float) -> None:
        left = deadline / self.factor - time.monotonic()
        if left > 0:
            time.sleep(left)


class InSimulation(RosOperator):
    """Mixin for the operator of a robot that ``fluxvla sim`` simulates; first of the bases.

    Args:
        seed: places the objects in the first episode; each later one adds 1.
        real_time_factor: what ``fluxvla sim`` was started with. Ages and time differences that the
            operator allows are in simulated seconds.
        **kwargs: as the robot's operator takes them.

    Raises:
        ConfigError: a value is impossible.
    """

    def __init__(self, seed: int = 0, real_time_factor: float = 1.0, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if not 0 < real_time_factor <= 1:
            raise ConfigError(
                f"real_time_factor must be above 0 and at most 1, got {real_time_factor:g}"
            )
        self.seed = seed
        self.real_time_factor = real_time_factor
        slowed = real_time_factor < 1
        self.clock = SlowedClock(real_time_factor) if slowed else MonotonicClock()
        self.max_age_s /= real_time_factor
        self.max_skew_s /= real_time_factor
        self._instruction = ""
        self._begun: tuple[float, float] | None = None
        self._judged: tuple[float, float] | None = None

    def streams(self) -> Sequence[StreamSpec]:
        return [*super().streams(), StreamSpec("facts", FACTS, STRING, AUXILIARY, depth=1)]

    def commands(self) -> Sequence[CommandSpec]:
        return [*super().commands(), CommandSpec(RESET, INT64, exclusive=False)]

    def on_connected(self, connection: Connection) -> None:
        """Compare the clocks.

        Raises:
            ConfigError: the simulator lives at another speed than it is driven at.
        """
        super().on_connected(connection)
        theirs = float(self.facts()["real_time_factor"])
        if theirs != self.real_time_factor:
            raise ConfigError(
                f"the simulator runs at {theirs:g} of real time, this operator is set to "
                f"{self.real_time_factor:g}",
                next=f"--set <{type(self).__name__}>.real_time_factor={theirs:g}, or start "
                f"fluxvla sim with --real-time-factor {self.real_time_factor:g}",
            )

    def get_frame(self) -> RobotFrame:
        """As the robot's operator; receipt stamps are on ``clock``.

        The part without commands does not begin episodes itself, and so raises Stale until every
        stream shows it.
        """
        if self._connection is not None and not self._part.commands and not self._shows_episode():
            raise Stale("the simulator shows nothing of the new episode yet")
        frame = super().get_frame()
        if self.real_time_factor == 1:
            return frame
        stamps = {name: at * self.real_time_factor for name, at in frame.stamps.items()}
        return replace(frame, stamps=stamps)

    def state_stamp(self) -> float:
        """As the robot's operator; on ``clock``."""
        return super().state_stamp() * self.real_time_factor

    def images_after(
        self, camera: str, after: float
    ) -> tuple[list[tuple[float, npt.NDArray[np.uint8]]], int]:
        """As the robot's operator; times are on ``clock``."""
        found, arrived = super().images_after(camera, after / self.real_time_factor)
        return [(at * self.real_time_factor, image) for at, image in found], arrived

    def begin_episode(self, instruction: str, episode: int) -> None:
        """Robot at home, objects where ``seed + episode`` puts them; waits until that is seen.

        Raises:
            NotReady: not connected, or the simulator does not do it in time.
        """
        seed, before = self.seed + episode, self.facts()["resets"]
        with self._lock:
            # The last command was for another episode: no stop may send the arm back there.
            self._last = None
            self.publish(RESET, message_class(INT64)(data=seed))

        def begun() -> bool:
            facts = self.facts()
            return facts["resets"] > before and facts["seed"] == seed

        self._wait(begun, f"the simulator did not begin an episode with seed {seed}")
        self._wait(self._shows_episode, "the simulator shows nothing of the new episode")
        self._instruction = instruction
        self._begun, self._judged = self._simulated(), None

    def task_success(self) -> bool | None:
        """Whether the task of the episode's instruction is done, as the simulator judges it.

        None where its scene has no task of these words.
        """
        self._judged = self._simulated()
        task = self._task()
        return None if task is None else bool(task["success"])

    def task_done(self) -> bool:
        """Whether the episode can end: nothing that comes could change :meth:`task_success`."""
        task = self._task()
        return task is not None and bool(task["done"])

    def facts(self) -> Mapping[str, Any]:
        """The newest message on ``/sim/facts``.

        Raises:
            NotReady: there was none yet.
        """
        return self._newest_facts()[0]

    def episode_facts(self) -> dict[str, Any]:
        """JSON values about how the last episode was simulated, for reports of its outcome.

        ``real_time_factor`` is what was stated, ``real_time_kept`` the share of it that the
        simulator reached from the episode's begin until it was judged. Below 0.95 a warning is
        logged: the control loop was faster than its robot then.
        """
        real_time_share = None
        if self._begun is not None and self._judged is not None:
            then, now = self._begun, self._judged
            wall = now[1] - then[1]
            real_time_share = (
                (now[0] - then[0]) / (wall * self.real_time_factor) if wall > 0 else None
            )
        if real_time_share is not None and real_time_share < _KEPT:
            log.warning(
                "the simulator kept %.0f %% of the time that it stated: this machine is too slow "
                "for a real-time factor of %g",
                100 * real_time_share,
                self.real_time_factor,
            )
        real_time_share = None if real_time_share is None else round(real_time_share, 3)
        return {"real_time_factor": self.real_time_factor, "real_time_kept": real_time_share}

    def _shows_episode(self) -> bool:
        """Whether everything that this operator reads is of the newest episode alone."""
        # A robot that jumps is nothing that matching in time reckons with: an image of the new
        # episode must not find the state of the old one within the skew that is allowed. Nor does
        # the simulator take commands in an episode's first 0.1 s.
        wait_s = max(self.max_skew_s, _SETTLE_S / self.real_time_factor)
        at = self.facts()["reset_at"] + round(wait_s * 1e9)
        streams = [spec.name for spec in self._specs if spec.kind in (STATE, CAMERA)]
        return all(self._stamp(name) >= at for name in streams)

    def _task(self) -> Mapping[str, Any] | None:
        words = self._instruction.casefold().split()
        tasks: Mapping[str, Mapping[str, Any]] = self.facts()["tasks"]
        found = (t for t in tasks.values() if t["instruction"].casefold().split() == words)
        return next(found, None)

    def _simulated(self) -> tuple[float, float]:
        """Simulated seconds of the newest facts, and when they came (monotonic)."""
        facts, receipt = self._newest_facts()
        return float(facts["time"]), receipt

    def _newest_facts(self) -> tuple[Mapping[str, Any], float]:
        received = self.newest("facts")
        if received is None:
            raise NotReady(f"the simulator ({FACTS}) has said nothing yet")
        return json.loads(received.message.data), received.receipt

    def _stamp(self, name: str) -> int:
        received = self.newest(name)
        if received is None:
            return 0
        stamp = received.message.header.stamp
        return int(stamp.sec) * 10**9 + int(stamp.nanosec)

    def _wait(self, happened: Callable[[], bool], failure: str) -> None:
        until = time.monotonic() + RESET_S / self.real_time_factor
        while not happened():
            if time.monotonic() > until:
                raise NotReady(
                    f"{failure} within {RESET_S:g} simulated seconds",
                    cause="it hangs, it is overloaded, or a fault holds its messages back",
                    next="look at the terminal that fluxvla sim runs in",
                )
            time.sleep(_POLL_S)


class AlohaSimROSOperator(InSimulation, AlohaOperator):
    """``AlohaOperator`` on ``fluxvla sim aloha --ros2``.

    Args:
        arms: ``viperx300``, as a real ALOHA's config says it.
        **kwargs: as ``InSimulation`` and ``AlohaOperator`` take them.

    Raises:
        ConfigError: other arms, or a value that is impossible.
    """

    def __init__(self, arms: str = "viperx300", **kwargs: Any) -> None:
        check_arms(arms, type(self).__name__)
        # One of the two says which arms there are.
        super().__init__(arms=None if kwargs.get("embodiment") else arms, **kwargs)


class URSimROSOperator(InSimulation, UROperator):
    """``UROperator`` on ``fluxvla sim ur5e --ros2``."""
