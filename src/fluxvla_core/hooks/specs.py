"""The hooks: when each is called, and with what. All observe; none can change an action.

A hook plugin is a class registered in ``fluxvla.hooks`` whose methods carry the names below; each
may take any subset of the arguments, by name. It is active only where a config names it
(``hooks = [dict(type="LatencyLog", every=10)]``): installing a package never changes what a run
does. Training hooks are called on rank 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import pluggy

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from fluxvla_core.build import RunContext
    from fluxvla_core.contracts.frame import Observation

hookspec = pluggy.HookspecMarker("fluxvla")


@hookspec
def run_started(context: RunContext) -> None:
    """Once, after everything is built and before the first unit of work."""


@hookspec
def run_finished(context: RunContext, outcome: str) -> None:
    """Once, always, also after an error; ``outcome`` is ``ok``, ``interrupted`` or ``failed``."""


@hookspec
def before_step(context: RunContext, step: int) -> None:
    """Before optimizer step ``step`` (counted from 1) reads its first batch."""


@hookspec
def after_step(context: RunContext, step: int, metrics: Mapping[str, float]) -> None:
    """After each step whose metrics were fetched (every log interval)."""


@hookspec
def checkpoint_saved(context: RunContext, path: Path, step: int) -> None:
    """After a checkpoint directory has its final name."""


@hookspec
def episode_started(context: RunContext, task: str) -> None:
    """Before the first observation of an episode on a robot."""


@hookspec
def observed(context: RunContext, observation: Observation) -> None:
    """After each observation that a policy is asked with; its arrays are read-only."""


@hookspec
def inferred(context: RunContext, chunk: npt.NDArray[np.float64], latency_s: float) -> None:
    """After each answer of a policy: ``(T, D)`` physical units, read-only, and how long it took."""


@hookspec
def action_sent(context: RunContext, action: npt.NDArray[np.float64], stamp: float) -> None:
    """After each command, as it was sent: ``(D,)`` physical units, read-only."""


@hookspec
def episode_finished(context: RunContext, reason: str) -> None:
    """After the safe stop that ends every episode; ``reason`` says what ended it."""


NAMES: tuple[str, ...] = tuple(
    name for name, value in sorted(vars().items()) if hasattr(value, "fluxvla_spec")
)
