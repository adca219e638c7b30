"""The contracts of runners, hooks, commands and reporters."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from fluxvla_core.contracts.contract import Contract, attribute, public_methods

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from fluxvla_core.contracts.frame import Observation
    from fluxvla_core.spec import EmbodimentSpec


class Runner(Contract):
    """Inference or evaluation, as a section of a config runs it.

    The command line calls the constructor, ``run_setup()`` and ``run()``.
    """

    @abstractmethod
    def run(self) -> Any:
        """Do the work; the result is shown and written."""

    @abstractmethod
    def run_setup(self) -> None:
        """Prepare: build what ``run`` needs."""

    @attribute
    def keeps_config(self) -> bool:
        """Whether it keeps the config with its results; the command line does it otherwise."""
        return False


class TrainRunner(Contract):
    """Training: called as ``run_setup(n_train_examples=len(dataset))``, then ``run(dataset)``."""

    @abstractmethod
    def run(self, vla_dataset: Any) -> Any:
        """Train on the dataset; the result is shown and written."""

    @abstractmethod
    def run_setup(self, *, n_train_examples: int) -> None:
        """Build model, optimizer and schedule."""

    @attribute
    def late_stop(self) -> int:
        """The signal that asked to stop when training was done already, else 0."""
        return 0


class Hook(Contract):
    """Observer of a run: overrides the methods that it wants to be called by.

    It must not change the run.

    A method may take any subset of its arguments, by name. A hook is active only where a config
    names it (``hooks = [dict(type="LatencyLog", every=10)]``): installing a package never changes
    what a run does. In training hooks are called on rank 0. ``context`` is the ``RunContext``.

    Every hook is called in a thread of its own, in the order of the events and shortly after them,
    and never keeps the run waiting. One that raises, or is more than ``budget_s`` behind, is
    reported once and left out for the rest of the run.
    """

    _any_arguments: ClassVar[bool] = True

    @attribute
    def budget_s(self) -> float:
        """Seconds that a call may take, with those that wait before it; 2 by default.

        A hook that uploads checkpoints sets more. The end of a run waits for it as long.
        """
        return 2.0

    def run_started(self, context: Any, embodiment: EmbodimentSpec | None) -> None:
        """Once, when everything is built and the first unit of work begins.

        ``embodiment`` is the robot's; None in training.
        """

    def run_finished(self, context: Any, outcome: str) -> None:
        """Once, always, also after an error; ``outcome``: ``ok``, ``interrupted`` or ``failed``."""

    def before_step(self, context: Any, step: int) -> None:
        """When optimizer step ``step`` (counted from 1) begins."""

    def after_step(self, context: Any, step: int, metrics: Mapping[str, float]) -> None:
        """After each step whose metrics were fetched (every log interval)."""

    def checkpoint_saved(self, context: Any, path: Path, step: int) -> None:
        """After a checkpoint directory has its final name."""

    def episode_started(self, context: Any, task: str, stamp: float) -> None:
        """When an episode on a robot begins, before its first observation.

        Every ``stamp`` is in seconds on the robot's clock.
        """

    def observed(self, context: Any, observation: Observation, stamp: float) -> None:
        """After each observation that a policy is asked with; its arrays are read-only."""

    def inferred(
        self, context: Any, chunk: npt.NDArray[np.float64], latency_s: float, stamp: float
    ) -> None:
        """After each answer of a policy: ``(T, D)`` physical units, read-only, and its duration."""

    def action_sent(
        self,
        context: Any,
        action: npt.NDArray[np.float64],
        stamp: float,
        target: npt.NDArray[np.float64],
        state: npt.NDArray[np.float64] | None,
    ) -> None:
        """After each command, as it was sent: ``(D,)`` physical units; all arrays are read-only.

        ``target`` is the ``(D,)`` command before filters and limits, ``state`` the ``(state_dim,)``
        state if it was read for this command.
        """

    def stopped(self, context: Any, rule: str, problem: str, stamp: float) -> None:
        """After a safe stop before the task was over: the safety rule, and the problem."""

    def episode_finished(self, context: Any, reason: str, stamp: float) -> None:
        """After the safe stop that ends every episode; ``reason`` says what ended it."""

    @classmethod
    def _enough(cls, candidate: type) -> tuple[tuple[str, ...], ...]:
        return tuple((name,) for name in public_methods(cls))


class Command(Contract):
    """A plugin's own ``fluxvla NAME …`` command."""

    help: ClassVar[str]

    @abstractmethod
    def add_arguments(self, parser: Any) -> None:
        """Add options to the ``argparse`` parser."""

    @abstractmethod
    def run(self, args: Any) -> int:
        """Do it; returns the exit code."""


class Reporter:
    """Receives the messages and progress of a run; this base class drops them all.

    Only rank 0 of a distributed run has one that shows anything.
    """

    def info(self, text: str) -> None:
        """One line for people."""

    def warn(self, text: str) -> None:
        """One line that somebody should read."""

    def progress(self, name: str, done: int, total: int | None, **fields: object) -> None:
        """``done`` of ``total`` units of ``name``; ``fields`` are shown next to it."""

    def event(self, kind: str, **fields: object) -> None:
        """One record for programs; ``fields`` are JSON values."""

    def artifact(self, kind: str, path: Path) -> None:
        """A file or folder that the run made and that somebody will look for."""

    def settle(self) -> None:
        """Leave the terminal to a person who is asked something: remove progress bars."""


class SilentReporter(Reporter):
    """Drops everything: the default, and what ranks other than 0 get."""
