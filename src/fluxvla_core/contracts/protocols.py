"""The contracts between the core and plugins, as protocols.

A class fulfils a contract by having its methods; nothing has to be inherited. ``contracts.check``
says what is missing when a class is loaded, because ``isinstance`` on a protocol would accept a
method with the wrong arguments.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from fluxvla_core.contracts.frame import Frame, Observation, Sample
from fluxvla_core.spec.embodiment import EmbodimentSpec

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

API: Mapping[str, str] = {
    "runners": "1.0",
    "operators": "1.0",
    "vlas": "1.0",
    "vision_backbones": "1.0",
    "llm_backbones": "1.0",
    "vlm_backbones": "1.0",
    "projectors": "1.0",
    "heads": "1.0",
    "datasets": "1.0",
    "transforms": "1.0",
    "collators": "1.0",
    "tokenizers": "1.0",
    "processors": "1.0",
    "metrics": "1.0",
    "optimizers": "1.0",
    "action_filters": "1.0",
    "hooks": "1.0",
    "environments": "1.0",
    "policies": "1.0",
    "commands": "1.0",
}
"""Contract version that this core speaks, by registry. A plugin declares ``api = "1.0"``: same
major and no newer minor than the core's is accepted (caret rule)."""


class Clock(Protocol):
    """Time as a robot lives it: monotonic for real ones, stepped for simulated ones."""

    def now(self) -> float:
        """Seconds; only differences mean something."""

    def sleep_until(self, deadline: float) -> None:
        """Return at ``deadline`` (seconds on this clock), at once if it is past."""


class Operator(Protocol):
    """One robot behind a fixed set of calls. The constructor does no I/O.

    ``embodiment`` is valid before ``connect``. ``contracts.optional`` has what an operator may have
    besides: a clock of its own, the state alone, and what it knows of tasks and episodes.
    """

    api: ClassVar[str]

    @property
    def embodiment(self) -> EmbodimentSpec: ...

    def connect(self) -> None:
        """Open the connection. Raises NotReady (try again), Rejected, or Faulted."""

    def get_frame(self) -> Frame:
        """The newest reading, in fresh arrays. Raises NotReady before the first one."""

    def send_action(self, action: npt.NDArray[np.float64]) -> None:
        """Send one ``(dim,)`` command in the embodiment's units.

        Raises Rejected for a wrong shape, a non-finite or out-of-spec value, before any I/O.
        """

    def stop(self) -> None:
        """Come to a safe stop and hold: in any state, from any thread, any number of times.

        A later stop, ``close``'s among them, sends the arm nothing unless ``send_action`` succeeded
        since: it may have been moved, and would be thrown back. An arm that somebody else commands
        is sent nothing at all. A speed, a mobile base's, is set to zero by every stop.
        """

    def close(self) -> None:
        """Give everything back; any number of times."""


class Policy(Protocol):
    """Observation in, chunk of actions out. Local model, remote server and replay are three of it.

    ``horizon`` actions come at ``action_rate_hz``; action ``j`` is to be reached
    ``(j + 1) / action_rate_hz`` seconds after the observation. One that can go on from a chunk that
    is being played has ``continue_action`` (``contracts.optional``).
    """

    @property
    def embodiment(self) -> EmbodimentSpec: ...
    @property
    def action_rate_hz(self) -> float: ...
    @property
    def horizon(self) -> int: ...

    def reset(self, seed: int) -> None:
        """Begin an episode; everything random in it follows from ``seed``."""

    def predict_action(self, observation: Observation) -> npt.NDArray[np.float64]:
        """``(horizon, dim)`` actions in physical units."""


class TrainRunner(Protocol):
    """Trains a policy. The command line calls the constructor, ``run_setup``, ``run``."""

    def run_setup(self, n_train_examples: int) -> None: ...
    def run(self, vla_dataset: Any) -> Any: ...


class Runner(Protocol):
    """Inference and evaluation: constructor, ``run_setup``, ``run``; no base class needed."""

    def run_setup(self) -> None: ...
    def run(self) -> Any: ...


class Dataset(Protocol):
    """Map-style samples; everything random in one follows from (seed, epoch, index)."""

    @property
    def statistics(self) -> Mapping[str, Any]: ...
    @property
    def embodiment(self) -> EmbodimentSpec | None: ...
    @property
    def fps(self) -> float: ...

    def __len__(self) -> int: ...
    def __getitem__(self, index: int) -> Sample: ...
    def get_sample(self, index: int, epoch: int) -> Sample: ...


class Transform(Protocol):
    """Sample in, sample out; never changes the arrays that it was given."""

    def __call__(self, sample: Sample) -> Sample: ...


class RandomTransform(Protocol):
    """A transform that draws; ``needs_rng = True`` tells the pipeline to hand it the generator."""

    needs_rng: ClassVar[bool]

    def __call__(self, sample: Sample, rng: np.random.Generator) -> Sample: ...


class Command(Protocol):
    """A plugin's own ``fluxvla NAME …`` command (entry-point group ``fluxvla.commands``)."""

    help: ClassVar[str]

    def add_arguments(self, parser: Any) -> None: ...
    def run(self, args: Any) -> int: ...
