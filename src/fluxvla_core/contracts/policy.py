"""The contract of policies: observation in, chunk of actions out."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from fluxvla_core.contracts.contract import Contract, attribute, implements, required
from fluxvla_core.contracts.environment import Environment
from fluxvla_core.contracts.frame import Observation
from fluxvla_core.spec import EmbodimentSpec

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


@dataclass(frozen=True)
class Continuation:
    """The prefix that a policy's next chunk has to continue (real-time chunking).

    It is the rest of the chunk that is being executed, at the times of the next one's actions.

    Args:
        actions: ``(T, dim)`` float64 in physical units, ``T`` being the policy's horizon: where
            the arm is going to be at the times of the new chunk's actions if no new chunk comes.
            Rows beyond the end of the current chunk repeat its last.
        weights: ``(T,)`` float64, how much the new chunk has to agree with each row: 1 for rows
            that will have been executed before the answer arrives, 0 for those that are free.
        frozen: how many rows at the beginning will have been executed, by measured latency.
        max_guidance_weight: bound of the pull towards ``actions``, for policies that are guided.
    """

    actions: npt.NDArray[np.float64]
    weights: npt.NDArray[np.float64]
    frozen: int
    max_guidance_weight: float = 5.0


class Actor(Contract):
    """Acts in an environment: a policy, an expert, a demonstrator."""

    @abstractmethod
    def reset(self, seed: int) -> None:
        """Begin an episode; everything random in it follows from ``seed``."""

    @abstractmethod
    def predict_action(self, observation: Observation) -> npt.NDArray[np.float64]:
        """``(T, dim)``: the next T actions, in physical units."""

    # -- optional abilities ----------------------------------------------------------------------

    @attribute
    def embodiment(self) -> EmbodimentSpec | None:
        """The embodiment of its numbers, which is checked; None: that of the environment."""
        return None

    @attribute
    def cameras(self) -> Sequence[str]:
        """Names of the cameras that it looks at; all of its ``embodiment`` by default."""
        return () if self.embodiment is None else self.embodiment.camera_names

    @attribute
    def action_rate_hz(self) -> float | None:
        """Actions a second; None is the environment's own rate."""
        return None

    @attribute
    def horizon(self) -> int | None:
        """Actions in a chunk; None where that is not known."""
        return None

    @attribute
    def n_obs_steps(self) -> int:
        """Observations that it acts on, the present one last; the others are the ``history`` of
        the observation that it gets."""
        return 1

    @attribute
    def executed(self) -> npt.NDArray[np.float64] | None:
        """``(N, dim)`` commands that lead to the last chunk's first action; None: a straight line.

        A demonstrator's executed commands may be noisier than the actions to learn.
        """
        return None

    def enter(self, environment: Environment) -> None:
        """Called when an episode has begun in ``environment``, before ``reset``.

        Scripted experts see there what others must look for.
        """

    @attribute
    def continues(self) -> bool:
        """Whether ``continue_action`` works; by default where a class brings it."""
        return implements(self, Actor, "continue_action")

    def continue_action(
        self, observation: Observation, rest: Continuation
    ) -> npt.NDArray[np.float64]:
        """Real-time chunking: ``(horizon, dim)`` actions in physical units that fit ``rest``."""
        raise NotImplementedError(f"{type(self).__name__} cannot continue a chunk")


def with_history(
    observation: Observation, n_obs_steps: int, before: Sequence[Observation] = ()
) -> Observation:
    """``observation`` with the ``history`` for a policy of ``n_obs_steps``.

    Args:
        before: earlier observations of the episode, one action apart, the oldest first. The first
            is repeated if there are too few; the present one if there are none.
    """
    if n_obs_steps == 1:
        return observation
    seen = [{**each} for each in (*before[1 - n_obs_steps :], observation)]
    for each in seen:
        each.pop("history", None)
    missing = n_obs_steps - len(seen)
    history: Any = (*[seen[0]] * missing, *seen[:-1])
    present: Any = {**observation, "history": history}
    found: Observation = present
    return found


class Policy(Actor):
    """A policy that can drive a robot. Local model, remote server and replay are three of it.

    ``horizon`` actions come at ``action_rate_hz``; action ``j`` is to be reached
    ``(j + 1) / action_rate_hz`` seconds after the observation.
    """

    @required
    def embodiment(self) -> EmbodimentSpec:
        """The embodiment of its numbers; must fit the robot's."""

    @required
    def action_rate_hz(self) -> float:
        """Actions a second."""

    @required
    def horizon(self) -> int:
        """Actions in a chunk."""

    # -- optional abilities ----------------------------------------------------------------------

    @attribute
    def source(self) -> object:
        """The origin of the policy, for the record: a checkpoint's path, a server's address."""
        return ""

    @attribute
    def stages(self) -> Mapping[str, float]:
        """Seconds that the parts of the last answer took, for the record."""
        return {}

    @attribute
    def whole_motion(self) -> bool:
        """Whether one chunk is the whole motion.

        It is then played to its end, however few actions of a chunk the runner's settings let be
        used before the next is asked for.
        """
        return False
