"""Conformance tests for environments, which a plugin inherits.

    from fluxvla_core.testing import EnvironmentConformance

    class TestMyEnvironment(EnvironmentConformance):
        entry_point = "MyEnvironment"

pytest collects the inherited tests. Evaluations rely on what they check: that an episode depends on
its task and seed alone, not on earlier episodes or on which cameras are drawn.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import pytest

from fluxvla_core.contracts.environment import Environment, EnvironmentSpec, TaskSpec
from fluxvla_core.contracts.frame import Observation
from fluxvla_core.evaluation.policies import RandomPolicy
from fluxvla_core.evaluation.rollout import Diverged, RolloutSettings, run_episode
from fluxvla_core.plugins.registry import ENVIRONMENTS
from fluxvla_core.spec.embodiment import Camera

SEED = 11


class DivergingPolicy(RandomPolicy):
    """Acts at random and, before its third chunk, sets impossible velocities in the simulation.

    Args:
        data: from an environment to its ``mujoco.MjData``.
    """

    def __init__(self, data: Callable[[Environment], Any]) -> None:
        super().__init__()
        self._data = data

    def enter(self, environment: Environment) -> None:
        super().enter(environment)
        self.environment, self.calls = environment, 0

    def predict_action(self, observation: Observation) -> npt.NDArray[np.float64]:
        self.calls += 1
        if self.calls == 3:
            self._data(self.environment).qvel[:] = 1e12
        return super().predict_action(observation)


class EnvironmentConformance:
    """Inherit, set ``entry_point`` and ``arguments``, and run pytest."""

    entry_point: ClassVar[str]
    """The environment's ``type`` in a config."""
    arguments: ClassVar[Mapping[str, Any]] = {}
    """Constructor arguments."""
    tasks: ClassVar[tuple[str, ...] | None] = None
    """Names of the tasks that are tried; by default the first two."""
    steps: ClassVar[int] = 12
    """Control steps of each episode here."""
    picture: ClassVar[tuple[int, int] | None] = (48, 64)
    """Height and width of the pictures here; None for environments that draw in one size only."""
    seeds_differ: ClassVar[bool] = True
    """Whether another seed makes another episode."""

    def make(self) -> Environment:
        """A new environment."""
        return Environment.adapt(ENVIRONMENTS.get(self.entry_point)(**self.arguments))

    @pytest.fixture
    def environment(self) -> Iterator[Environment]:
        """A new environment; closed after the test."""
        made = self.make()
        yield made
        made.close()

    def simulation(self, environment: Environment) -> Any:
        """``mujoco.MjData`` of the episode, which a test makes diverge; None without MuJoCo.

        By default the attribute ``simulation``, as ``fluxvla_mujoco.MujocoEnvironment`` has it.
        """
        return getattr(environment, "simulation", None)

    def tried(self, environment: Environment) -> tuple[TaskSpec, ...]:
        """The tasks that are tried."""
        if self.tasks is None:
            return environment.spec.tasks[:2]
        return tuple(task for task in environment.spec.tasks if task.name in self.tasks)

    def cameras(self, environment: Environment) -> tuple[Camera, ...]:
        """One camera, in the size of ``picture``; none where there is none."""
        known = environment.spec.embodiment.cameras[:1]
        if self.picture is None:
            return known
        return tuple(Camera(camera.name, *self.picture) for camera in known)

    def episode(
        self,
        environment: Environment,
        task: TaskSpec,
        seed: int = SEED,
        cameras: tuple[Camera, ...] = (),
    ) -> dict[str, Any]:
        """The record of an episode of random actions, without its timing."""
        settings = RolloutSettings(cameras=cameras, max_steps=self.steps)
        record = run_episode(environment, RandomPolicy(), task, seed, settings)
        return {name: value for name, value in record.items() if name != "timing"}

    def test_the_spec_is_there_before_anything_is_built(self) -> None:
        environment = self.make()
        spec = environment.spec
        environment.close()
        assert isinstance(spec, EnvironmentSpec)
        assert json.loads(json.dumps(dict(spec.details))) == dict(spec.details), "JSON values"
        assert all(task.max_steps > 0 and task.instruction for task in spec.tasks)

    def test_what_is_seen_is_what_the_spec_says(self, environment: Environment) -> None:
        spec = environment.spec
        for task in self.tried(environment):
            environment.reset(SEED, task.name)
            state = environment.state
            assert state.shape == (spec.embodiment.state_dim,)
            assert state.dtype == np.float64
            assert np.isfinite(state).all()
            seen = environment.observe(self.cameras(environment))
            assert seen["qpos"].dtype == np.float32
            assert np.array_equal(seen["qpos"], state.astype(np.float32))
            assert seen["task_description"] == task.instruction
            for camera in self.cameras(environment):
                image = seen["images"][camera.name]
                assert image.dtype == np.uint8
                assert image.shape == (camera.height, camera.width, 3)
            assert environment.observe(())["images"] == {}, "nothing is rendered unasked"

    def test_states_belong_to_whoever_asked(self, environment: Environment) -> None:
        environment.reset(SEED, self.tried(environment)[0].name)
        before = environment.state
        kept = before.copy()
        joints = environment.spec.embodiment.joints
        environment.step(np.array([(joint.lower + joint.upper) / 2 for joint in joints]))
        assert np.array_equal(before, kept), "a later step changed a state that was given out"

    def test_a_course_follows_from_task_and_seed_alone(self, environment: Environment) -> None:
        tasks = self.tried(environment)
        first = {task.name: self.episode(environment, task) for task in tasks}
        for task in reversed(tasks):
            self.episode(environment, task, SEED + 1)
            assert self.episode(environment, task) == first[task.name], "after other episodes"
        other = self.make()
        assert self.episode(other, tasks[0]) == first[tasks[0].name], "in a new environment"
        other.close()

    def test_another_seed_is_another_course(self, environment: Environment) -> None:
        if not self.seeds_differ:
            pytest.skip("this environment begins every episode alike")
        task = self.tried(environment)[0]
        hashes = {self.episode(environment, task, seed)["state_hash"] for seed in (1, 2, 3)}
        assert len(hashes) > 1

    def test_looking_changes_nothing(self, environment: Environment) -> None:
        task = self.tried(environment)[0]
        unseen = self.episode(environment, task)
        assert self.episode(environment, task, cameras=self.cameras(environment)) == unseen

    def test_a_simulation_that_diverges_is_an_error_and_no_outcome(
        self, environment: Environment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)  # where MuJoCo leaves its log
        task = self.tried(environment)[0]
        environment.reset(SEED, task.name)
        if self.simulation(environment) is None:
            pytest.skip("no MuJoCo simulation below")
        settings = RolloutSettings(max_steps=self.steps)
        why = ""
        try:
            run_episode(environment, DivergingPolicy(self.simulation), task, SEED, settings)
        except Diverged as error:
            why = error.what
        assert re.search(r"BADQVEL|not finite", why), (
            "the simulation diverged and divergence() did not say so: inherit from "
            "fluxvla_mujoco.MujocoEnvironment, or return fluxvla_mujoco.divergence(data)"
        )
        assert self.episode(environment, task), "the next episode is a whole one again"

    def test_it_can_be_closed_any_number_of_times(self, environment: Environment) -> None:
        environment.reset(SEED, self.tried(environment)[0].name)
        environment.close()
        environment.close()
