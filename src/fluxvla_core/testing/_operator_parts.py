"""Helpers of the operator kit, and its checks of an operator that two processes divide."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar

import numpy as np
import pytest

from fluxvla_core.contracts.frame import Frame
from fluxvla_core.contracts.robot import Operator
from fluxvla_core.errors import NotReady, OperatorError, Rejected
from fluxvla_core.plugins.registry import OPERATORS
from fluxvla_core.spec import EmbodimentSpec

Array = np.ndarray[Any, np.dtype[np.float64]]
# No command in this time means that no more are under way. It passes in so many looks, because a
# machine that stands still delays commands too, and the time of one look at most.
_QUIET_S, _LOOKS = 0.5, 10
# How far a joint of an arm at rest may be read apart by two who read it at different times, and how
# far one is commanded to see whether it moves, in its unit: small enough for any servo.
_APART, STEP = 0.01, 0.03


class DividedOperatorChecks:
    """Base of the kit of operators: ``parts`` and their checks."""

    entry_point: ClassVar[str]
    arguments: ClassVar[Mapping[str, Any]] = {}
    ready_within_s: ClassVar[float] = 10.0

    @pytest.fixture
    def parts(self) -> Iterator[tuple[Any, Any]]:
        """The part without cameras and the one without commands, not connected; closed at the end.

        Each is of an operator of its own, as in the two processes that share a robot. Tests that
        use it are skipped for an operator that cannot be divided.
        """
        first, second = (
            Operator.adapt(OPERATORS.get(self.entry_point)(**self.arguments)) for _ in range(2)
        )
        control, cameras = first.without_cameras(), second.without_commands()
        made = [part for part in (cameras, control) if part is not None]
        try:
            assert len(made) != 1, (
                f"without_cameras() gave {control!r} and without_commands() {cameras!r}: a robot "
                "is divided into both parts, or not at all"
            )
            if not made:
                needs = "without_cameras() and without_commands()"
                pytest.skip(f"this operator cannot be divided: it would define {needs}")
            yield Operator.adapt(control), Operator.adapt(cameras)
        finally:
            for part in [*made, first, second]:
                Operator.adapt(part).close()

    def frame(self, operator: Any) -> Frame:
        """One frame.

        Override it for an operator of the specification's shape, whose ``get_frame`` gives what its
        own runner understands: make a ``Frame`` of that, and raise NotReady where there is none.
        """
        frame: Frame = operator.get_frame()
        return frame

    def first_frame(self, operator: Any) -> Frame:
        """Wait for the first frame; NotReady is the one error that means 'try again'."""
        deadline = time.monotonic() + self.ready_within_s
        while True:
            try:
                return self.frame(operator)
            except NotReady:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.02)

    def hold(self, operator: Any) -> Array:
        """The command that keeps the arm where it is, inside the limits, and a base still."""
        return self._held(operator.embodiment, self.frame(operator).state)

    def _held(self, embodiment: EmbodimentSpec, state: Array) -> Array:
        joints = embodiment.joints
        where = dict(zip(embodiment.state_names, state, strict=True))
        there = [0.0 if joint.by_speed else where.get(joint.name, joint.lower) for joint in joints]
        limits = [joint.lower for joint in joints], [joint.upper for joint in joints]
        return np.clip(np.array(there, dtype=np.float64), *limits)

    def commands_heard(self, operator: Any) -> int | None:
        """The number of commands the arm, or its stand-in, has received; override to count them.

        None, where nobody does: then a stop that throws an arm back goes unnoticed here.
        """
        return None

    def settled(self, operator: Any) -> int | None:
        """``commands_heard`` once no more come; fails if they continue for ``ready_within_s``."""
        deadline = time.monotonic() + self.ready_within_s
        heard, looks = self.commands_heard(operator), 0
        while heard is not None and looks < _LOOKS:
            time.sleep(_QUIET_S / _LOOKS)
            before, heard = heard, self.commands_heard(operator)
            looks = looks + 1 if heard == before else 0
            assert looks or time.monotonic() < deadline, (
                f"commands still arrive after {self.ready_within_s:g} s without a send_action, "
                f"{heard} by now: what sends them does not end"
            )
        return heard

    def _hears_more(self, operator: Any, than: int) -> bool:
        """Wait until ``commands_heard`` is more than that; a command may be under way for long."""
        deadline = time.monotonic() + self.ready_within_s
        while (heard := self.commands_heard(operator)) is not None and heard <= than:
            if time.monotonic() > deadline:
                return False
            time.sleep(0.02)
        return True

    def test_both_parts_read_the_robot_at_the_same_time(self, parts: tuple[Any, Any]) -> None:
        control, cameras = parts
        self._connect(parts)
        spec = cameras.embodiment
        assert control.embodiment == spec, (
            "without_cameras().embodiment and without_commands().embodiment differ: each is that "
            "of the whole robot"
        )
        images = self.frame(cameras).images
        assert set(images) == set(spec.camera_names), (
            f"get_frame() of the part without commands has the images {sorted(images)}, expected "
            f"{sorted(spec.camera_names)}: the policy is asked with these frames"
        )
        assert self._refused(control.get_frame, NotReady), (
            "get_frame() of the part without cameras gave a frame, expected NotReady: it would "
            "keep the process waiting that commands the robot"
        )
        self._until(
            lambda: np.allclose(self._state(control), self._state(cameras), rtol=0.0, atol=_APART),
            lambda: (
                f"get_state() of the part without cameras gave {self._state(control)}, that of the "
                f"part without commands {self._state(cameras)}; expected at most {_APART} apart, "
                "because both read one robot, which nobody commands"
            ),
        )

    def test_a_command_of_one_part_is_seen_by_the_other(self, parts: tuple[Any, Any]) -> None:
        control, cameras = parts
        self._connect(parts)
        spec = control.embodiment
        before = self._state(cameras)
        target = self._held(spec, before)
        names = spec.state_names
        index = next(i for i, j in enumerate(spec.joints) if j.name in names and not j.by_speed)
        joint, column = spec.joints[index], names.index(spec.joints[index].name)
        step = min(STEP, (joint.upper - joint.lower) / 4.0)
        upwards = joint.upper - target[index] > target[index] - joint.lower
        target[index] += step if upwards else -step

        def seen() -> bool:
            control.send_action(target)
            return bool(abs(self._state(cameras)[column] - before[column]) > step / 2.0)

        self._until(
            seen,
            lambda: (
                f"send_action() of the part without cameras moves {joint.name} from "
                f"{before[column]:.4g} to {target[index]:.4g}, and get_state() of the part without "
                f"commands gives {self._state(cameras)[column]:.4g} after "
                f"{self.ready_within_s:g} s: expected the robot that the other part commands"
            ),
        )

    def test_the_part_without_commands_sends_nothing(self, parts: tuple[Any, Any]) -> None:
        control, cameras = parts
        self._connect(parts)
        # So that there is a command to repeat, if only by mistake.
        held = self._held(control.embodiment, self._state(control))
        earlier = self.commands_heard(cameras)
        control.send_action(held)
        if earlier is not None:
            self._hears_more(cameras, earlier)
        before = self.settled(cameras)
        assert self._refused(lambda: cameras.send_action(held), Rejected), (
            "send_action() of the part without commands took a command, expected Rejected: "
            "another process commands the robot"
        )
        cameras.stop()
        cameras.close()
        cameras.stop()
        after = self.settled(cameras)
        assert after == before, (
            f"commands_heard() was {before} before send_action(), stop() and close() of the part "
            f"without commands, and is {after} now, expected {before}: that part sends nothing, "
            "because the arm has the commands of the other one"
        )
        control.send_action(held)  # nor did closing take the robot from the other part

    def _connect(self, parts: tuple[Any, Any]) -> None:
        """Both, the one without commands first: it needs nobody who commands."""
        control, cameras = parts
        cameras.connect()
        self.first_frame(cameras)
        control.connect()
        self._until(lambda: self._state(control) is not None, lambda: "")

    def _state(self, part: Any) -> Array:
        state = part.get_state()
        assert state is not None, (
            "get_state() of a part gave None, expected the state: the process without cameras has "
            "no other reading, and both must read the same"
        )
        return np.asarray(state, dtype=np.float64)

    def _refused(self, call: Callable[[], object], error: type[OperatorError]) -> bool:
        try:
            call()
        except error:
            return True
        return False

    def _until(self, condition: Callable[[], bool], failure: Callable[[], str]) -> None:
        """Wait for ``condition``; NotReady is forgiven, as of a stream that is late once."""
        deadline = time.monotonic() + self.ready_within_s
        while True:
            late = time.monotonic() > deadline
            try:
                if condition():
                    return
                assert not late, failure()
            except NotReady:
                if late:
                    raise
            time.sleep(0.02)


def not_followed(spec: EmbodimentSpec, column: int, step: float, moved: Array) -> str:
    """The message for a state whose ``column`` did not follow a command by ``step``."""
    name = spec.state_names[column]
    sent = f"send_action() moves {name} by {step:.4g}, and "
    why = ": the arm is watched by its state, and a policy is asked with it"
    others = np.abs(moved)
    others[column] = 0.0
    furthest = int(others.argmax())
    if np.abs(moved).max() < abs(step) / 100.0:
        return f"{sent}the state did not change, expected {name} to follow{why}"
    if others[furthest] > abs(step) / 2.0:
        return (
            f"{sent}the state of {spec.state_names[furthest]} changed by {moved[furthest]:.4g}, "
            f"that of {name} by {moved[column]:.4g}; expected {name} alone: are the columns in the "
            f"order of the joint names, {', '.join(spec.state_names)}"
            "?"
        )
    ratio = moved[column] / step
    unit = " (degrees for radians?)" if abs(ratio - 180.0 / np.pi) < 10.0 else ""
    return f"{sent}its state changed by {moved[column]:.4g}, {ratio:.3g} times that{unit}{why}"
