"""Any simulator behind a small contract, so that the engine can run its episodes.

An environment knows tasks by name and begins each episode from a seed; a policy is asked for chunks
of actions. The record of an episode follows from its key alone if the environment keeps its word
about seeds; its hash makes it easy to see whether it does.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import Observation
from fluxvla_core.errors import RunFailed
from fluxvla_core.evaluate.ledger import EpisodeKey


@dataclass(frozen=True)
class Step:
    """What came of one action.

    Args:
        observation: what is seen now.
        reward: of this step.
        success: whether the task is done now.
        ended: whether the environment ends the episode here.
    """

    observation: Observation
    reward: float
    success: bool
    ended: bool


class Environment(Protocol):
    """Tasks to be done; made in the process that uses it."""

    def reset(self, seed: int, task: str) -> Observation:
        """Begin an episode of ``task``; everything random in it follows from ``seed``."""

    def step(self, action: npt.NDArray[np.float64]) -> Step:
        """Execute one action."""

    def close(self) -> None:
        """Give everything back; any number of times."""


class Actor(Protocol):
    """What an environment needs of a policy: the Policy contract without its embodiment."""

    def reset(self, seed: int) -> None: ...

    def predict_action(self, observation: Observation) -> npt.NDArray[np.float64]:
        """``(T, D)``: the next T actions."""


@dataclass(frozen=True)
class EnvironmentEpisodes:
    """A factory for ``run_episodes``: an environment and a policy in each worker process.

    Args:
        environment, policy: called in the worker; functions of a module, or ``functools.partial``
            of them, because they are sent there. A policy with an ``enter(environment)`` is told
            where it acts: that is how scripted experts see what others must look for.
        max_steps: steps after which an episode ends.
        replan_every: how many actions of a chunk are executed before the next is asked for.
    """

    environment: Callable[[], Environment]
    policy: Callable[[], Actor]
    max_steps: int
    replan_every: int = 1

    def __post_init__(self) -> None:
        if self.max_steps < 1 or self.replan_every < 1:
            raise ValueError(
                f"max_steps ({self.max_steps}) and replan_every ({self.replan_every}) "
                "must be at least 1"
            )

    def __call__(self) -> Callable[[EpisodeKey], dict[str, Any]]:
        environment, policy = self.environment(), self.policy()
        if hasattr(policy, "enter"):
            policy.enter(environment)
        return lambda key: self.episode(environment, policy, key)

    def episode(self, environment: Environment, policy: Actor, key: EpisodeKey) -> dict[str, Any]:
        """Run one episode until success, the environment's end, or ``max_steps``.

        Returns:
            JSON values: ``success``, ``steps``, ``calls``, ``return`` (sum of rewards) and
            ``state_hash`` (of everything that was seen; equal for equal episodes).

        Raises:
            RunFailed: the policy's chunk is empty, not finite, or no matrix.
        """
        observation = environment.reset(key.seed, key.task)
        policy.reset(key.seed)
        digest = hashlib.sha256()
        _add(digest, observation)
        steps = calls = 0
        total, success, ended = 0.0, False, False
        while not (success or ended) and steps < self.max_steps:
            chunk = _checked(policy.predict_action(observation))
            calls += 1
            for action in chunk[: self.replan_every]:
                found = environment.step(action)
                observation, steps, total = found.observation, steps + 1, total + found.reward
                success, ended = found.success, found.ended
                _add(digest, observation)
                if success or ended or steps >= self.max_steps:
                    break
        return {
            "success": success,
            "steps": steps,
            "calls": calls,
            "return": total,
            "state_hash": digest.hexdigest()[:16],
        }


class GymnasiumEnvironment:
    """One Gymnasium environment as one task.

    The observation's ``qpos`` is everything numeric in Gymnasium's observation in one row, sorted
    by key; pictures (``(H, W, 3)`` uint8) are its ``images`` by key, ``image`` where there are no
    keys.

    Args:
        make: gives the environment, for example ``partial(gymnasium.make, "FetchReach-v4")``.
        success: from (observation, reward, terminated, info) to whether the task is done; by
            default ``info["is_success"]`` or ``info["success"]``, and an error without either.
        instructions: task -> instruction; the task's name by default.

    Raises:
        RunFailed: an episode's end cannot be judged.
    """

    def __init__(
        self,
        make: Callable[[], Any],
        success: Callable[[Any, float, bool, Mapping[str, Any]], bool] | None = None,
        instructions: Mapping[str, str] | None = None,
    ) -> None:
        self.env = make()
        self._success = success or success_of_info
        self._instructions = dict(instructions or {})
        self._task = ""

    def reset(self, seed: int, task: str) -> Observation:
        self._task = task
        # Some environments draw their tasks from the action space's generator, or sample from it.
        self.env.action_space.seed(seed)
        seen, _ = self.env.reset(seed=seed)
        return self._observation(seen)

    def step(self, action: npt.NDArray[np.float64]) -> Step:
        space = self.env.action_space
        seen, reward, terminated, truncated, info = self.env.step(
            np.asarray(action, space.dtype).reshape(space.shape)
        )
        done = bool(self._success(seen, float(reward), bool(terminated), info))
        ended = bool(terminated) or bool(truncated)
        return Step(self._observation(seen), float(reward), done, ended)

    def close(self) -> None:
        self.env.close()

    def _observation(self, seen: Any) -> Observation:
        parts = dict(seen) if isinstance(seen, Mapping) else {"image": seen}
        images: dict[str, npt.NDArray[np.uint8]] = {}
        rows = []
        for key in sorted(parts):
            array = np.asarray(parts[key])
            if array.dtype == np.uint8 and array.ndim == 3 and array.shape[2] == 3:
                images[key] = array
            else:
                rows.append(array.astype(np.float32).ravel())
        return {
            "qpos": np.concatenate(rows) if rows else np.zeros(0, np.float32),
            "images": images,
            "task_description": self._instructions.get(self._task, self._task),
        }


def success_of_info(seen: Any, reward: float, terminated: bool, info: Mapping[str, Any]) -> bool:
    """``is_success`` or ``success`` of the step's info.

    Raises:
        RunFailed: neither is there.
    """
    for key in ("is_success", "success"):
        if key in info:
            return bool(info[key])
    raise RunFailed(
        f"the environment does not say whether its task is done; its info has {sorted(info)}",
        next="give GymnasiumEnvironment a success function",
    )


def _checked(chunk: Any) -> npt.NDArray[np.float64]:
    array = np.asarray(chunk, dtype=np.float64)
    if array.ndim != 2 or not array.size:
        raise RunFailed(f"the policy's chunk has shape {array.shape}; (T, D) is needed")
    if not np.isfinite(array).all():
        raise RunFailed("the policy's chunk is not finite")
    return array


def _add(digest: Any, observation: Observation) -> None:
    digest.update(np.ascontiguousarray(observation["qpos"]).tobytes())
    for name in sorted(observation["images"]):
        digest.update(np.ascontiguousarray(observation["images"][name]).tobytes())
