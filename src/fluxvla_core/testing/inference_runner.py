"""Conformance tests for inference runners, which a plugin inherits.

    from fluxvla_core.testing import InferenceRunnerConformance

    class TestMyInferenceRunner(InferenceRunnerConformance):
        entry_point = "MyInferenceRunner"

pytest collects the inherited tests. They let the runner drive a robot in memory, whose time passes
with its commands, and look at every command that it was sent; nothing real moves.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import numpy as np
import numpy.typing as npt
import pytest

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.contracts.policy import Policy
from fluxvla_core.errors import Faulted, FluxError
from fluxvla_core.spec import EmbodimentSpec
from fluxvla_core.testing._conformance import Conformance, equal, is_json
from fluxvla_core.testing.stand_ins import (
    CLOSE,
    COMMAND,
    CONNECT,
    SPEC,
    STOP,
    StandInPolicy,
    StandInRobot,
    near,
    within,
)

Array = npt.NDArray[np.float64]
TASK, INSTRUCTION = "1", "wave at the camera"
SEED = 7
STEPS = 150
"""Commands of an episode, enough to get to the goal."""
# What part of the way a last command may be away from the goal, and how far commands may be beyond
# a limit, as a share of it: rounding.
_AWAY, _ROUNDING = 0.02, 1e-6
_GOAL_S = 0.3
"""Seconds at full speed to the goal."""
# Faster than any joint, and less far in one chunk than safety takes for a motion.
_HASTE = 1.8
_FAULTS = {
    "policy": "the policy raised an error",
    "chunk": "the policy gave a chunk of NaN",
    "command": "the robot did not take a command",
    "frame": "the robot reported a fault instead of a reading",
    "interrupt": "Ctrl-C was pressed",
}
_AFTER = 8
"""Commands after which the robot fails."""


class InferenceRunnerConformance(Conformance):
    """Inherit, set ``entry_point`` and ``arguments``, and run pytest.

    ``arguments`` are further keys of the section. A runner whose operator has methods of its own
    instead of ``send_action`` overrides ``robot``: a subclass of ``StandInRobot`` with these.
    """

    registry = "runners"
    spec: ClassVar[EmbodimentSpec] = SPEC
    """The robot that it is to drive."""

    def robot(self) -> StandInRobot:
        """A new robot in memory."""
        return StandInRobot(self.spec)

    def section(self, robot: StandInRobot, policy: Policy, **more: Any) -> dict[str, Any]:
        """The config's section, with objects instead of tables for the robot and the policy."""
        return {
            "type": self.entry_point,
            "operator": robot,
            "policy": policy,
            "task_descriptions": {TASK: INSTRUCTION},
            "max_publish_step": STEPS,
            "record_fps": None,
            "seed": SEED,
            **self.arguments,
            **more,
        }

    def build(
        self, work_dir: Path, robot: Any, policy: Any, task: str | None = TASK, **more: Any
    ) -> Any:
        """A new runner, as the command line builds it."""
        context = RunContext(section="inference", work_dir=work_dir, task=task)
        return build_runner_from_cfg(self.section(robot, policy, **more), context)

    def drive(self, work_dir: Path, robot: Any, policy: Any, **more: Any) -> Any:
        """The result of a whole run."""
        runner = self.build(work_dir, robot, policy, **more)
        runner.run_setup()
        return runner.run()

    def policy(self, **settings: Any) -> StandInPolicy:
        """One that goes a way which every joint can go."""
        goal = near(self.spec, self.robot().start, _GOAL_S)
        return StandInPolicy(self.spec, goal, **settings)

    def test_building_it_moves_nothing(self, tmp_path: Path) -> None:
        robot = self.robot()
        self.build(tmp_path, robot, self.policy()).run_setup()
        assert not robot.events, (
            f"the constructor and run_setup() did {', '.join(robot.events)} to the robot, expected "
            "nothing before run(): what does not fit is refused without a robot"
        )

    def test_the_policy_is_asked_with_what_the_robot_sees(self, tmp_path: Path) -> None:
        robot, policy = self.robot(), self.policy()
        images = {camera.name: robot.image(camera) for camera in self.spec.cameras}
        state = robot.state.copy()
        self.drive(tmp_path, robot, policy)
        assert policy.asked, "run() ended and the policy was never asked, expected a first question"
        first = policy.asked[0]
        said = first.get("task_description")
        assert said == INSTRUCTION, (
            f"the policy was asked to {said!r}, expected {INSTRUCTION!r}, the instruction of task "
            f"{TASK!r}: it would do something else than it was told"
        )
        assert np.allclose(first["qpos"], state, atol=1e-5), (
            f"the first observation's qpos is {np.asarray(first['qpos']).tolist()}, expected "
            f"{state.tolist()}, the state of the robot in the order of its joints: the policy "
            "would take the arm to be elsewhere"
        )
        missing = sorted(set(images) - set(first["images"]))
        assert not missing, (
            f"the first observation has no image of {', '.join(missing)}, at which the policy "
            "looks (its cameras)"
        )
        for name, image in images.items():
            found = first["images"][name]
            shown = [other for other, p in images.items() if equal(found, p)]
            assert name in shown, (
                f"the first observation's image of {name} is {_shown(found, shown)}, expected "
                f"what the robot's {name} sees, {image.shape} uint8 RGB"
            )

    def test_commands_are_the_policys(self, tmp_path: Path) -> None:
        robot, policy = self.robot(), self.policy()
        self.drive(tmp_path, robot, policy)
        self._sane(robot)
        ways = np.abs(policy.goal - robot.start)
        away = np.abs(robot.sent[-1] - policy.goal) - _AWAY * ways
        furthest = int(away.argmax())
        assert away.max() < _ROUNDING, (
            f"the policy went to {policy.goal.tolist()}, and the last of {len(robot.sent)} "
            f"commands is {robot.sent[-1].tolist()}, expected the same to {_AWAY:.0%} of the way; "
            f"furthest is {self.spec.joint_names[furthest]}: other columns, another unit, or "
            "actions that are left out?"
        )

    def test_commands_keep_the_limits(self, tmp_path: Path) -> None:
        """With a policy that asks for more than the velocity and position limits."""
        robot, policy = self.robot(), StandInPolicy(self.spec, within(self.spec, 1.1), _HASTE)
        self.drive(tmp_path, robot, policy)
        self._sane(robot)
        rate = self.spec.rate_hz
        path = np.vstack([robot.start, robot.start, *robot.sent])
        speed = np.diff(path, axis=0) * rate
        push = np.diff(speed, axis=0) * rate
        why = "the arm is slower, or stronger, than what is near it"
        for column, joint in enumerate(self.spec.joints):
            low, high = path[:, column].min(), path[:, column].max()
            slack = _ROUNDING * (joint.upper - joint.lower)
            assert joint.lower - slack <= low <= high <= joint.upper + slack, (
                f"{joint.name} was commanded to {low:.4g} and {high:.4g} {joint.unit}, expected "
                f"{joint.lower:g} to {joint.upper:g}: the policy may want more, the robot must not"
            )
            if joint.by_speed:
                continue
            fastest = np.abs(speed[:, column]).max()
            assert fastest <= joint.velocity * (1 + _ROUNDING), (
                f"two commands to {joint.name} are apart by {fastest:.4g} {joint.unit}/s, expected "
                f"at most its velocity, {joint.velocity:g}: {why}. Are commands left out, or sent "
                "more rarely than they were made for?"
            )
            hardest = np.abs(push[:, column]).max()
            assert hardest <= joint.acceleration * (1 + 1e3 * _ROUNDING), (
                f"commands to {joint.name} change their speed by {hardest:.4g} {joint.unit}/s², "
                f"expected at most its acceleration, {joint.acceleration:g}: {why}"
            )

    def test_the_robot_is_stopped_and_given_back(self, tmp_path: Path) -> None:
        robot = self.robot()
        self.drive(tmp_path, robot, self.policy())
        self._stopped(robot, "a task that was done")

    @pytest.mark.parametrize("fault", list(_FAULTS))
    def test_whatever_happens_the_robot_is_stopped(self, tmp_path: Path, fault: str) -> None:
        robot, policy = self.robot(), self.policy()
        happens = _happens(robot)
        if fault == "policy":
            policy.fault = lambda chunk: _raise(RuntimeError("the stand-in's policy failed"))
        elif fault == "chunk":
            policy.fault = lambda chunk: np.full_like(chunk, np.nan)
        elif fault == "interrupt":
            policy.fault = lambda chunk: os.kill(os.getpid(), signal.SIGINT)
        elif fault == "command":
            robot.on_command = happens
        else:
            robot.on_frame = happens
        raised: BaseException | None = None
        try:
            self.drive(tmp_path, robot, policy)
            time.sleep(0.05)  # a signal is handled between two instructions of the main thread
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - looked at below
            raised = error
        assert raised is not None, (
            f"{_FAULTS[fault]}, and run() returned as if it had been done, expected an error: "
            "whoever started it takes the task for done"
        )
        if fault == "interrupt":
            assert isinstance(raised, KeyboardInterrupt), (
                f"{_FAULTS[fault]}, and run() raised {type(raised).__name__}: {raised}, expected "
                "KeyboardInterrupt: the command line ends the whole run by that"
            )
        self._stopped(robot, f"a run in which {_FAULTS[fault]}")

    def test_an_unknown_task_is_refused_before_anything_moves(self, tmp_path: Path) -> None:
        robot, task = self.robot(), "7 no such task"
        problem: Exception | None = None
        try:
            runner = self.build(tmp_path, robot, self.policy(), task=task)
            robot.events.clear()  # what the constructor does is looked at elsewhere
            runner.run_setup()
            runner.run()
        except Exception as error:  # noqa: BLE001 - looked at below
            problem = error
        assert isinstance(problem, FluxError), (
            f"--task {task!r} gave {problem!r}, expected an error of fluxvla_core.errors: a "
            "misspelt task is reported in one line, and the policy does not do another one"
        )
        moved = [event for event in robot.events if event in (CONNECT, COMMAND)]
        assert not moved, (
            f"--task {task!r} was refused after {', '.join(moved)}, expected before the robot is "
            "connected"
        )

    def test_what_run_returns_is_json(self, tmp_path: Path) -> None:
        result = self.drive(tmp_path, self.robot(), self.policy())
        assert is_json(result), (
            f"run() returned {result!r:.200}, expected JSON values alone: programs read it from "
            "fluxvla run --log-format json"
        )

    def test_an_episode_follows_from_its_seed(self, tmp_path: Path) -> None:
        runs = []
        for name, seed in (("first", SEED), ("again", SEED), ("other", SEED + 100)):
            robot, policy = self.robot(), self.policy(noise=0.05)
            self.drive(tmp_path / name, robot, policy, seed=seed)
            runs.append((robot.sent, policy.seeds))
        (first, seeds), (again, _), (_, others) = runs
        assert seeds, "the policy's reset(seed) was not called before its first question"
        assert seeds != others, (
            f"with seed = {SEED} and {SEED + 100} the policy's reset() had {seeds} both times, "
            "expected another seed: all episodes would have the same noise"
        )
        assert equal(first, again), (
            f"two runs with seed = {SEED} sent other commands, expected the same: what happened on "
            "a robot could not be tried again"
        )

    def _sane(self, robot: StandInRobot) -> None:
        """Commands were sent, each a row of finite numbers."""
        assert robot.sent, (
            "run() ended and the robot was sent no command, expected those of the policy: does "
            "_execute_actions() send them?"
        )
        dim = self.spec.dim
        bad = [row for row in robot.sent if row.shape != (dim,) or not np.isfinite(row).all()]
        assert not bad, (
            f"the robot was sent {bad[0].tolist()}, expected {dim} finite numbers: "
            f"{', '.join(self.spec.joint_names)}"
        )

    def _stopped(self, robot: StandInRobot, what: str) -> None:
        """After its last command the robot was stopped, then closed."""
        events = robot.events
        last = max((n for n, event in enumerate(events) if event == COMMAND), default=-1)
        assert last >= 0, f"the robot was sent no command in {what}"
        after = events[last + 1 :]
        assert STOP in after, (
            f"after {what} the robot was not stopped: its last command was followed by "
            f"{', '.join(after) or 'nothing'}, expected stop: it would go on to where it was sent"
        )
        assert events[-1] == CLOSE, (
            f"after {what} the last that was done to the robot is {events[-1]}, expected close: "
            "nobody else can connect to it"
        )


def _happens(robot: StandInRobot) -> Callable[[], None]:
    def fail() -> None:
        if len(robot.sent) >= _AFTER:
            raise Faulted("the stand-in reports a fault")

    return fail


def _raise(error: BaseException) -> NoReturn:
    raise error


def _shown(found: Any, known: list[str]) -> str:
    if known:
        return f"that of {known[0]}"
    return f"{getattr(found, 'dtype', type(found).__name__)} of shape {np.shape(found)}"
