"""A robot as a runner uses it, whether its operator has the full contract or only some of it.

The specification's operators have ``get_frame`` and commands of their own (``servoj``,
``movegrip``), no specs, and open their connection in the constructor. One like that is accepted
when the config gives the ``embodiment`` that it lacks; the runner's ``_execute_actions`` sends.
"""

from __future__ import annotations

import inspect
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.check import missing_operator_methods
from fluxvla_core.control.clock import clock_of, in_lockstep
from fluxvla_core.errors import ConfigError, Faulted, FluxError, LoadFailed, SpecMismatch
from fluxvla_core.spec.embodiment import EmbodimentSpec, check_match

# How long a safe stop may take before a person is told to use the emergency stop.
STOP_S = 5.0
_LEAST_SPEED = 0.01
_NOTHING = object()


@dataclass(frozen=True)
class Measured:
    """``(state_dim,)`` where the robot was, and when that arrived, on its clock."""

    state: npt.NDArray[np.float64]
    at: float


class Robot:
    """An operator, its embodiment and its clock.

    Args:
        operator: an object; not connected yet if it has ``connect``.
        embodiment: what the config says about it; None when it has its own.
        sends: whether the runner has an ``_execute_actions`` of its own, and so needs no
            ``send_action``.

    Raises:
        LoadFailed: the operator lacks something that nothing makes up for.
        SpecMismatch: the config's embodiment and the operator's own differ.
    """

    def __init__(
        self,
        operator: Any,
        embodiment: EmbodimentSpec | Mapping[str, Any] | None = None,
        sends: bool = False,
    ) -> None:
        self.operator = operator
        self.name = type(operator).__name__
        self.embodiment = self._embodiment(embodiment)
        lacks = missing_operator_methods(operator)
        self.complete = not lacks
        self._require("get_frame()", lacks, "no reading could be had from it")
        if not sends:
            self._require("send_action()", lacks, "no command could be sent to it")
        self.sent_s: float | None = None
        # A recorded robot goes its own way; that it does is no fault of its.
        self.follows = bool(getattr(operator, "follows_commands", True))
        self.clock = clock_of(operator)
        self.lockstep = in_lockstep(self.clock)

    def connect(self) -> None:
        """Open the connection, where there is a ``connect``; the constructor did it otherwise.

        Raises:
            OperatorError: what the operator raised.
        """
        self._call("connect")

    def send(self, action: npt.NDArray[np.float64]) -> None:
        """Send one ``(D,)`` command; ``sent_s`` is how long the last one took.

        Raises:
            OperatorError: what the operator raised; anything that is none becomes ``Faulted``.
        """
        began = time.perf_counter()
        self._call("send_action", action)
        self.sent_s = time.perf_counter() - began

    def state(self) -> Measured | None:
        """The state alone, from an operator that has ``get_state``; else None.

        It is read after each command, on a real robot while another thread may read frames.
        """
        read = getattr(self.operator, "get_state", None)
        if read is None:
            return None
        tell = getattr(self.operator, "state_stamp", None)
        # The stamp first: what arrives in between is newer than it says, which does no harm.
        at = None if tell is None else float(tell())
        state = np.asarray(read(), dtype=np.float64)
        return Measured(state, self.clock.now() if at is None else at)

    @property
    def speed(self) -> Callable[[], float] | None:
        """Tells the share of its speed that a person lets it have (``speed_scaling``), or None."""
        operator = self.operator
        if not _has(operator, "speed_scaling"):
            return None
        # An arm that is paused takes no command, and says so when it is given one.
        return lambda: min(max(float(operator.speed_scaling), _LEAST_SPEED), 1.0)

    def commanded(self, before: npt.NDArray[np.float64] | None) -> npt.NDArray[np.float64] | None:
        """``(D,)`` what the arm was told last, None if nothing, or nothing that still counts.

        Args:
            before: the last command of this run, for operators that do not tell (``last_action``).
        """
        if _has(self.operator, "last_action"):
            last = self.operator.last_action
            return None if last is None else np.asarray(last, dtype=np.float64)
        # Who begins episodes may put the arm elsewhere.
        return None if hasattr(self.operator, "begin_episode") else before

    @property
    def tells_hold(self) -> bool:
        """Whether ``commanded`` holds after a stop too: without ``last_action`` an operator's own
        ``stop`` may have commanded anything."""
        return _has(self.operator, "last_action") or not self.can_stop

    def success(self) -> bool | None:
        """Whether the task is done as of now, where the operator can tell (``task_success``)."""
        tell = getattr(self.operator, "task_success", None)
        found = None if tell is None else tell()
        return None if found is None else bool(found)

    def done(self) -> bool:
        """Whether the episode can end here, where the operator can tell (``task_done``)."""
        tell = getattr(self.operator, "task_done", None)
        return tell is not None and bool(tell())

    def begin(self, instruction: str, episode: int) -> None:
        """Tell an operator that wants to know (``begin_episode``) that an episode begins.

        Simulations put their objects in place then; ``episode`` counts from 0.
        """
        self._call("begin_episode", instruction, episode)

    @property
    def can_stop(self) -> bool:
        """Whether the operator itself knows how to stop."""
        return callable(getattr(self.operator, "stop", None))

    def stop(self) -> str | None:
        """Bring the robot to a safe stop; None, or what went wrong. Never raises, never hangs."""
        return self._bounded("stop")

    def close(self) -> str | None:
        """Give the connection back; None, or what went wrong. Never raises, never hangs."""
        return self._bounded("close")

    def _call(self, method: str, *arguments: Any) -> None:
        function = getattr(self.operator, method, None)
        if function is None:
            return
        try:
            function(*arguments)
        except FluxError:
            raise
        except Exception as error:
            raise Faulted(f"{self.name}.{method} raised {type(error).__name__}: {error}") from error

    def _bounded(self, method: str) -> str | None:
        function: Callable[[], object] | None = getattr(self.operator, method, None)
        if function is None:
            return None
        problem: list[str] = []
        if self.lockstep:
            # Simulations are bound to one thread (renderers are), and cannot hurt anybody.
            return self._reported(method, function)

        def call() -> None:
            problem.extend(filter(None, [self._reported(method, function)]))

        thread = threading.Thread(target=call, name=f"fluxvla-{method}", daemon=True)
        thread.start()
        thread.join(STOP_S)
        if thread.is_alive():
            return (
                f"{self.name}.{method} did not return within {STOP_S:g} s: "
                "use the robot's emergency stop"
            )
        return problem[0] if problem else None

    def _reported(self, method: str, function: Callable[[], object]) -> str | None:
        try:
            function()
        except Exception as error:  # noqa: BLE001 - reported; the rest of the stop goes on
            return f"{self.name}.{method} raised {type(error).__name__}: {error}"
        return None

    def _embodiment(self, given: EmbodimentSpec | Mapping[str, Any] | None) -> EmbodimentSpec:
        if given is not None and not isinstance(given, (EmbodimentSpec, Mapping)):
            raise ConfigError(f"embodiment must be a table, got {given!r}")
        said = EmbodimentSpec.from_dict(given) if isinstance(given, Mapping) else given
        own = getattr(self.operator, "embodiment", None)
        if own is None and said is None:
            raise LoadFailed(
                f"{self.name} has no embodiment: which joints it moves and within which limits is "
                "not known, so nothing may be sent to it",
                cause="an operator of the specification's shape describes no robot",
                next="give the section embodiment = dict(name=…, joints=[…], cameras=[…], "
                "rate_hz=…), or the operator an attribute embodiment",
            )
        if own is None:
            assert said is not None
            return said
        if not isinstance(own, EmbodimentSpec):
            raise LoadFailed(
                f"{self.name}.embodiment is a {type(own).__name__}, not an EmbodimentSpec"
            )
        if said is not None:
            check_match(said, own, "the config's embodiment", self.name)
            _check_tighter(said, own)
            return said
        return own

    def _require(self, method: str, lacks: list[str], why: str) -> None:
        if method in lacks:
            raise LoadFailed(
                f"{self.name} has no {method}; {why}",
                next="see docs/writing-a-plugin.md for what an operator has, or give the runner "
                "an _execute_actions of its own",
            )


def _has(operator: Any, name: str) -> bool:
    """Whether there is such an attribute; a property is not asked, which may raise."""
    return inspect.getattr_static(operator, name, _NOTHING) is not _NOTHING


def _check_tighter(said: EmbodimentSpec, own: EmbodimentSpec) -> None:
    """A config may narrow a robot's limits; it cannot widen them."""
    for ours, theirs in zip(said.joints, own.joints, strict=True):
        wider = {
            "lower": ours.lower < theirs.lower,
            "upper": ours.upper > theirs.upper,
            "velocity": ours.velocity > theirs.velocity,
            "acceleration": ours.acceleration > theirs.acceleration,
        }
        for name, is_wider in wider.items():
            if is_wider:
                raise SpecMismatch(
                    f"the config's embodiment widens {name} of {ours.name} to "
                    f"{getattr(ours, name):g}; the robot's own limit is {getattr(theirs, name):g}"
                )
