"""Conformance tests for hooks, which a plugin inherits.

    from fluxvla_core.testing import HookConformance

    class TestMyHook(HookConformance):
        entry_point = "MyHook"

pytest collects the inherited tests. A hook watches: one that raises is left out for the rest of a
run, and so is one that falls behind its ``budget_s``.
"""

from __future__ import annotations

import inspect
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from fluxvla_core.build import RunContext, build_from_cfg
from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.frame import Observation
from fluxvla_core.contracts.runner import Hook
from fluxvla_core.errors import nearest
from fluxvla_core.hooks import NAMES
from fluxvla_core.plugins.registry import HOOKS
from fluxvla_core.testing._conformance import Conformance, raised, shapes

Call = tuple[str, Mapping[str, Any]]
_NEAR = 0.75
"""Likeness from which a method's name is taken for a misspelt hook."""


class HookConformance(Conformance):
    """Inherit, set ``entry_point`` and ``arguments``, and run pytest."""

    registry = "hooks"
    at_most_s: ClassVar[float] = 0.02
    """Seconds that a call may take: a command interval at 50 Hz."""
    joints: ClassVar[int] = 2
    """Of the robot that it watches: numbers of a state and of an action."""
    cameras: ClassVar[Mapping[str, tuple[int, int]]] = {"front": (4, 6)}
    """Of the robot: name -> height and width of its images."""

    @pytest.fixture
    def watched(self, tmp_path: Path) -> Watched:
        """A run that it watches."""
        return Watched(self.entry_point, self.make_in, tmp_path)

    def make_in(self, context: RunContext) -> Any:
        """A new hook, as the run builds it: with the context, if it asks for that."""
        return build_from_cfg({"type": self.entry_point, **self.arguments}, HOOKS, context)

    def robot(self) -> list[Call]:
        """The calls in an episode of a robot."""
        return robot(self.joints, self.cameras)

    def test_every_method_is_a_hook(self) -> None:
        own = [n for n, f in vars(self.component()).items() if callable(f) and n[:1] != "_"]
        for name in own:
            near = None if name in NAMES else nearest(name, NAMES, _NEAR)
            assert near is None, (
                f"{name}() is called by nobody; expected {near}(), if that was meant: hooks are "
                "found by their names"
            )

    def test_a_training_can_be_watched(self, watched: Watched) -> None:
        watched.calls(training(watched.context.work_dir), "ok")
        assert not watched.problems, watched.message("a training")

    def test_a_robot_can_be_watched(self, watched: Watched) -> None:
        watched.calls(self.robot(), "ok")
        assert not watched.problems, (
            watched.message("a robot's run")
            + "; the robot has joints and cameras as this kit's subclass sets them"
        )

    @pytest.mark.parametrize("outcome", ["failed", "interrupted"])
    def test_a_run_may_end_at_once(self, watched: Watched, outcome: str) -> None:
        watched.calls([], outcome)
        assert not watched.problems, watched.message(f"a run that {outcome} before its first step")

    def test_what_it_sees_is_not_its_own(self, watched: Watched) -> None:
        metrics = {"loss": 0.5, "lr": 1e-3}
        watched.calls([("after_step", {"step": 1, "metrics": metrics})], "ok")
        assert metrics == {"loss": 0.5, "lr": 1e-3}, (
            f"after_step() changed its metrics to {metrics}, expected them untouched: other hooks "
            "and the reporter are given the same"
        )

    def test_it_is_quick_enough(self, watched: Watched) -> None:
        watched.calls(10 * self.robot() + 10 * training(watched.context.work_dir), "ok")
        for name, taken in watched.taken.items():
            middle = float(np.median(taken))
            assert middle < self.at_most_s, (
                f"{name}() took {1e3 * middle:.3g} ms, expected less than "
                f"{1e3 * self.at_most_s:.3g}: calls that wait for it add up, and it is left out "
                "when it "
                "falls behind its budget_s"
            )

    def test_nothing_is_left_running(self, watched: Watched) -> None:
        before = set(threading.enumerate())
        watched.calls(self.robot(), "ok")
        left = [t.name for t in threading.enumerate() if t not in before and not t.daemon]
        assert not left, (
            f"after run_finished() the threads {', '.join(left)} still run, expected them ended: "
            "the process would never end"
        )


class Watched:
    """A run that a hook watches: calls it as the core does, and collects its errors."""

    def __init__(self, name: str, make: Any, work_dir: Path) -> None:
        work_dir.mkdir(exist_ok=True)
        self.problems: list[str] = []
        self.context = RunContext(work_dir=work_dir)
        self.taken: dict[str, list[float]] = {}
        self._name = name
        self._hook = make(self.context)

    def calls(self, middle: list[Call], outcome: str) -> None:
        """``run_started``, the calls of ``middle``, ``run_finished``."""
        self._call("run_started", embodiment=None)
        for name, arguments in middle:
            self._call(name, **arguments)
        self._call("run_finished", outcome=outcome)

    def _call(self, name: str, **arguments: Any) -> None:
        if self.problems or not implements(self._hook, Hook, name):
            return  # one that raised is left out
        method = getattr(self._hook, name)
        parameters = inspect.signature(method).parameters.values()
        values = {"context": self.context, **arguments}
        if not any(p.kind is p.VAR_KEYWORD for p in parameters):
            values = {p.name: values[p.name] for p in parameters if p.name in values}
        start = time.perf_counter()
        try:
            method(**values)
        except Exception as error:  # noqa: BLE001 - said in the assertion
            message = f"hook {self._name}.{name} raised {raised(error)}"
            self.problems.append(f"{message}; it was given {shapes(arguments)}")
        self.taken.setdefault(name, []).append(time.perf_counter() - start)

    def message(self, what: str) -> str:
        """The message about its problems while it watched ``what``."""
        return (
            f"watching {what}: {'; '.join(self.problems)}; expected no error: from the first on a "
            "hook is left out for the rest of the run"
        )


def training(work_dir: Path) -> list[Call]:
    """The calls in two steps of a training and at its checkpoint."""
    calls: list[Call] = []
    for step in (1, 2):
        calls.append(("before_step", {"step": step}))
        metrics = {"loss": 1.0 / step, "lr": 1e-3, "step_time": 0.1, "grad_norm": 0.5}
        calls.append(("after_step", {"step": step, "metrics": metrics}))
    path = work_dir / "checkpoints" / "step-000000002"
    path.mkdir(parents=True, exist_ok=True)
    return [*calls, ("checkpoint_saved", {"path": path, "step": 2})]


def robot(joints: int, cameras: Mapping[str, tuple[int, int]]) -> list[Call]:
    """The calls in an episode of two chunks on a robot; arrays are read-only."""
    chunk, state = np.zeros((3, joints)), np.zeros(joints, np.float32)
    images = {name: np.zeros((*side, 3), np.uint8) for name, side in cameras.items()}
    arrays: list[np.ndarray[Any, Any]] = [chunk, state, *images.values()]
    for array in arrays:
        array.flags.writeable = False
    seen: Observation = {"qpos": state, "images": images, "task_description": "wave"}
    calls: list[Call] = [("episode_started", {"task": "wave", "stamp": 0.0})]
    for _ in range(2):
        calls.append(("observed", {"observation": seen, "stamp": 0.0}))
        calls.append(("inferred", {"chunk": chunk, "latency_s": 0.05, "stamp": 0.05}))
        for number, row in enumerate(chunk):
            sent = {"action": row, "stamp": 0.02 * number, "target": row, "state": None}
            calls.append(("action_sent", sent))
    calls.append(("stopped", {"rule": "tracking", "problem": "it lags behind", "stamp": 0.2}))
    return [*calls, ("episode_finished", {"reason": "done", "stamp": 0.2})]
