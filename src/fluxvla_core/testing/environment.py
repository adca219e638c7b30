"""Conformance tests for environments, which a plugin inherits.

    from fluxvla_core.testing import EnvironmentConformance

    class TestMyEnvironment(EnvironmentConformance):
        entry_point = "MyEnvironment"

pytest collects the inherited tests. Evaluations rely on what they check: that an episode depends on
its task and seed alone, not on earlier episodes or on which cameras are drawn.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import pytest

from fluxvla_core.contracts.environment import Environment, EnvironmentSpec, Step, TaskSpec
from fluxvla_core.contracts.frame import Observation
from fluxvla_core.errors import FluxError
from fluxvla_core.evaluation.policies import RandomPolicy
from fluxvla_core.evaluation.rollout import RolloutSettings, run_episode
from fluxvla_core.evaluation.stepping import Diverged
from fluxvla_core.plugins.registry import ENVIRONMENTS, POLICIES
from fluxvla_core.spec import Camera
from fluxvla_core.testing._conformance import Renamed, is_json, unequal_keys

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


class _SameActions(RandomPolicy):
    """The same random actions in every episode; it keeps its observations."""

    def reset(self, seed: int) -> None:
        super().reset(SEED)
        self.seen: list[Any] = []

    def predict_action(self, observation: Observation) -> npt.NDArray[np.float64]:
        images = {name: image.tobytes() for name, image in observation["images"].items()}
        self.seen.append((observation["qpos"].tolist(), images))
        return super().predict_action(observation)


class EnvironmentConformance(Renamed):
    """Inherit, set ``entry_point`` and ``arguments``, and run pytest."""

    entry_point: ClassVar[str]
    """The environment's ``type`` in a config."""
    arguments: ClassVar[Mapping[str, Any]] = {}
    """Constructor arguments."""
    tasks: ClassVar[tuple[str, ...] | None] = None
    """Names of the tasks that are tried; by default the first two."""
    steps: ClassVar[int] = 12
    """Control steps of each episode here."""
    image_size: ClassVar[tuple[int, int] | None] = (48, 64)
    """Height and width of the images here; None for environments that draw in one size only."""
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
        """One camera, in the size of ``image_size``; none where there is none."""
        known = environment.spec.embodiment.cameras[:1]
        if self.image_size is None:
            return known
        return tuple(Camera(camera.name, *self.image_size) for camera in known)

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

    def course(self, environment: Environment, task: TaskSpec, seed: int) -> str:
        """States, images and rewards of an episode as text; actions do not depend on ``seed``."""
        policy = _SameActions()
        settings = RolloutSettings(cameras=self.cameras(environment), max_steps=self.steps)
        record = run_episode(environment, policy, task, seed, settings)
        return repr((policy.seen, record["state_hash"], record.get("return")))

    def test_the_spec_is_there_before_anything_is_built(self) -> None:
        environment = self.make()
        spec = environment.spec
        environment.close()
        assert isinstance(spec, EnvironmentSpec), (
            f"spec is a {type(spec).__name__} before reset(), expected an EnvironmentSpec: policy "
            "and environment are compared before a scene is built"
        )
        assert is_json(dict(spec.details)), (
            f"spec.details is {dict(spec.details)!r:.200}, expected JSON values alone: they go "
            "into "
            "results.json"
        )
        for task in spec.tasks:
            assert task.max_steps > 0, (
                f"task {task.name} has max_steps = {task.max_steps}, expected at least 1: after so "
                "many an episode ends"
            )
            assert task.instruction, f"task {task.name} has no instruction, which policies go by"

    def test_what_is_seen_is_what_the_spec_says(self, environment: Environment) -> None:
        spec = environment.spec
        for task in self.tried(environment):
            environment.reset(SEED, task.name)
            state, dim = environment.state, spec.embodiment.state_dim
            assert state.shape == (dim,), (
                f"state has the shape {state.shape}, expected ({dim},): one number for each of "
                f"{', '.join(spec.embodiment.state_names)}; a state of other values than an action "
                "has them in EmbodimentSpec(state_joints=...)"
            )
            assert state.dtype == np.float64, f"state is {state.dtype}, expected float64"
            assert np.isfinite(state).all(), (
                f"state is {state.tolist()} after reset(), expected finite numbers: the episode "
                "counts as diverged otherwise"
            )
            seen = environment.observe(self.cameras(environment))
            qpos = seen["qpos"]
            assert qpos.dtype == np.float32, f"observe()['qpos'] is {qpos.dtype}, expected float32"
            assert np.array_equal(qpos, state.astype(np.float32)), (
                f"observe()['qpos'] is {qpos.tolist()}, and state {state.tolist()}; expected the "
                "same, rounded: demonstrations record the one, policies see the other"
            )
            assert seen["task_description"] == task.instruction, (
                f"observe()['task_description'] is {seen['task_description']!r}, expected "
                f"{task.instruction!r}, that of the task {task.name}"
            )
            for camera in self.cameras(environment):
                image = seen["images"].get(camera.name)
                assert image is not None, (
                    f"observe() of the camera {camera.name} gave the images "
                    f"{sorted(seen['images'])}, expected that one: the policy looks at it"
                )
                assert image.dtype == np.uint8, (
                    f"the image of {camera.name} is {image.dtype}, expected uint8 from 0 to 255"
                )
                assert image.shape == (camera.height, camera.width, 3), (
                    f"the image of {camera.name} has the shape {image.shape}, expected "
                    f"{(camera.height, camera.width, 3)}, as asked for"
                )
            unasked = environment.observe(())["images"]
            assert unasked == {}, (
                f"observe(()) gave the images {sorted(unasked)}, expected none: rendering is what "
                "takes the time"
            )

    def test_a_step_says_what_it_did(self, environment: Environment) -> None:
        task = self.tried(environment)[0]
        environment.reset(SEED, task.name)
        succeeded = False
        for action in self._actions(environment):
            given = action.copy()
            step = environment.step(given)
            assert isinstance(step, Step), (
                f"step() gave a {type(step).__name__}, expected a Step: reward, success, ended"
            )
            assert np.array_equal(given, action), (
                "step() changed the action that it was given, expected it untouched: it is a row "
                "of the policy's chunk"
            )
            assert step.success or not succeeded, (
                "step() said success, and then no more, expected it to stay: it says whether the "
                "task is done now or was at any moment before"
            )
            succeeded = step.success
            if step.ended:
                break

    def _actions(self, environment: Environment) -> npt.NDArray[np.float64]:
        """``(steps, dim)`` at random within the limits."""
        joints = environment.spec.embodiment.joints
        low, high = [j.lower for j in joints], [j.upper for j in joints]
        return np.random.default_rng(SEED).uniform(low, high, (self.steps, len(joints)))

    def test_states_belong_to_whoever_asked(self, environment: Environment) -> None:
        environment.reset(SEED, self.tried(environment)[0].name)
        before = environment.state
        kept = before.copy()
        joints = environment.spec.embodiment.joints
        environment.step(np.array([(joint.lower + joint.upper) / 2 for joint in joints]))
        assert np.array_equal(before, kept), (
            "a later step() changed a state that was given out, expected fresh arrays: a "
            "demonstration would record the last one everywhere"
        )

    def test_a_course_follows_from_task_and_seed_alone(self, environment: Environment) -> None:
        tasks = self.tried(environment)
        first = {task.name: self.episode(environment, task) for task in tasks}
        why = "results follow from task and seed, whichever process ran what before"
        for task in reversed(tasks):
            self.episode(environment, task, SEED + 1)
            again = self.episode(environment, task)
            differ = unequal_keys(first[task.name], again)
            assert not differ, (
                f"after reset({SEED}, {task.name!r}) the same actions gave another "
                f"{', '.join(differ)} when other episodes had been run before, expected the same: "
                f"{why}"
            )
        other = self.make()
        differ = unequal_keys(first[tasks[0].name], self.episode(other, tasks[0]))
        other.close()
        assert not differ, (
            f"after reset({SEED}, {tasks[0].name!r}) the same actions gave another "
            f"{', '.join(differ)} in a second environment, expected the same: {why}"
        )

    def test_another_seed_is_another_course(self, environment: Environment) -> None:
        if not self.seeds_differ:
            pytest.skip("this environment begins every episode alike")
        task = self.tried(environment)[0]
        courses = {self.course(environment, task, seed) for seed in (1, 2, 3)}
        assert len(courses) > 1, (
            "reset() with the seeds 1, 2 and 3 and the same actions gave the same states, images "
            "and rewards, expected others: the seed is "
            "ignored, and fifty episodes would be one (set seeds_differ = False if that is meant)"
        )
        environment.reset(1, task.name)
        starts = [environment.state]
        environment.reset(1, task.name)
        starts.append(environment.state)
        assert np.array_equal(starts[0], starts[1]), (
            f"reset(1, {task.name!r}) gave the state {starts[0].tolist()} and then "
            f"{starts[1].tolist()}, expected the same: everything random follows from the seed"
        )

    def test_looking_changes_nothing(self, environment: Environment) -> None:
        task = self.tried(environment)[0]
        environment.reset(SEED, task.name)
        for cameras in ((), self.cameras(environment)):
            before = environment.state
            environment.observe(cameras)
            after = environment.state
            assert np.array_equal(before, after), (
                f"observe() with {len(cameras)} camera(s) took the state from {before.tolist()} to "
                f"{after.tolist()}, expected no change: it is called when a policy or a video "
                "looks, which must not move the world"
            )
        unseen = self.episode(environment, task)
        seen = self.episode(environment, task, cameras=self.cameras(environment))
        differ = unequal_keys(unseen, seen)
        assert not differ, (
            f"an episode with images has another {', '.join(differ)} than one without, expected "
            "the same: observe() moves the world, or draws from its generator"
        )

    def test_other_tasks_are_others_and_can_be_instructed(self, environment: Environment) -> None:
        tried = [(task, environment.other_tasks(task.name)) for task in self.tried(environment)]
        if not any(others for _, others in tried):
            pytest.skip("other_tasks() and set_instruction() would allow instruction_swap")
        known = {task.name: task for task in environment.spec.tasks}
        for task, others in tried:
            assert task.name not in others, (
                f"other_tasks({task.name!r}) gave {list(others)}, expected others than itself: a "
                "swapped instruction would be the right one"
            )
            strangers = sorted(set(others) - set(known))
            assert not strangers, (
                f"other_tasks({task.name!r}) gave {strangers}, expected names of spec.tasks, "
                f"{', '.join(known)}"
            )
            for other in others[:1]:
                environment.reset(SEED, task.name)
                environment.set_instruction(other)
                said = environment.observe(())["task_description"]
                assert said == known[other].instruction, (
                    f"after set_instruction({other!r}) the policy is told {said!r}, expected "
                    f"{known[other].instruction!r}: an evaluation would read as if no policy "
                    "listened"
                )
                environment.reset(SEED, task.name)
                said = environment.observe(())["task_description"]
                assert said == task.instruction, (
                    f"after the next reset() the policy is told {said!r}, expected "
                    f"{task.instruction!r}: an instruction is for one episode"
                )

    def test_its_expert_is_there(self, environment: Environment) -> None:
        expert = environment.expert
        if expert is None:
            pytest.skip("expert would name the policy that solves its tasks, for demonstrations")
        problem = ""
        try:
            POLICIES.get(expert)
        except FluxError as error:
            problem = str(error)
        assert not problem, (
            f"expert is {expert!r}, and policy = 'expert' in a config says: {problem}"
        )

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
        assert self.episode(environment, task), "the next episode is no whole one again"

    def test_it_can_be_closed_any_number_of_times(self, environment: Environment) -> None:
        environment.reset(SEED, self.tried(environment)[0].name)
        environment.close()
        problem = ""
        try:
            environment.close()
        except Exception as error:  # noqa: BLE001 - said in the assertion
            problem = f"{type(error).__name__}: {error}"
        assert not problem, (
            f"a second close() raised {problem}; expected it to do nothing: whatever ends an "
            "evaluation closes"
        )
