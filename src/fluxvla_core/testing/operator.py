"""Conformance tests for operators, which a plugin inherits.

    from fluxvla_core.testing import OperatorConformance

    class TestMyRobotOperator(OperatorConformance):
        entry_point = "MyRobotOperator"
        arguments = {"address": "127.0.0.1"}

pytest collects the inherited tests. ``arguments`` must reach a robot, or a stand-in for one, that
the tests may move; override the ``operator`` fixture to start such a stand-in first, and ``parts``
too if the operator can be divided.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar
from unittest import mock

import numpy as np
import pytest

from fluxvla_core.config.runtime_signature import inspect_signature
from fluxvla_core.contracts.check import missing_operator_methods
from fluxvla_core.contracts.frame import STATE, Frame
from fluxvla_core.contracts.robot import Operator
from fluxvla_core.errors import NotReady, OperatorError, Rejected
from fluxvla_core.plugins.registry import OPERATORS
from fluxvla_core.spec.embodiment import EmbodimentSpec

# No command in this time means that no more are under way.
_QUIET_S = 0.3
# How far a joint of an arm at rest may be read apart by two who read it at different times, and how
# far one is commanded to see whether it moves, in its unit: small enough for any servo.
_APART, _STEP = 0.01, 0.03
# How long importing a plugin in a new process may take.
_IMPORT_S = 120.0
_IMPORT_PROBE = """
import importlib, json, sys, threading
importlib.import_module(sys.argv[1])
print(json.dumps([sorted({m.partition(".")[0] for m in sys.modules}), threading.active_count()]))
"""


class OperatorConformance:
    """Inherit, set ``entry_point`` and ``arguments``, and run pytest."""

    entry_point: ClassVar[str]
    """The operator's ``type`` in a config."""
    arguments: ClassVar[Mapping[str, Any]] = {}
    """Constructor arguments that reach the robot or its stand-in."""
    heavy_modules: ClassVar[tuple[str, ...]] = ("torch", "rclpy")
    """Modules that importing the plugin may not pull in."""
    ready_within_s: ClassVar[float] = 10.0
    """How long each wait of the tests may take: for a first frame, for newer readings, for the end
    of commands after a stop."""

    @pytest.fixture
    def operator(self) -> Iterator[Any]:
        """A new, unconnected operator; closed after the test."""
        operator = OPERATORS.get(self.entry_point)(**self.arguments)
        yield operator
        operator.close()

    @pytest.fixture
    def connected(self, operator: Any) -> Any:
        operator.connect()
        self.first_frame(operator)
        return operator

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
        """One reading.

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

    def hold(self, operator: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
        """The command that keeps the arm where it is, inside the limits."""
        return self._held(operator.embodiment, self.frame(operator).state)

    def _held(
        self, embodiment: EmbodimentSpec, state: np.ndarray[Any, np.dtype[np.float64]]
    ) -> np.ndarray[Any, np.dtype[np.float64]]:
        joints = embodiment.joints
        where = dict(zip(embodiment.state_names, state, strict=True))
        target = [np.clip(where.get(j.name, j.lower), j.lower, j.upper) for j in joints]
        return np.array(target, dtype=np.float64)

    def commands_heard(self, operator: Any) -> int | None:
        """The number of commands the arm, or its stand-in, has received; override to count them.

        None, where nobody does: then a stop that throws an arm back goes unnoticed here.
        """
        return None

    def settled(self, operator: Any) -> int | None:
        """``commands_heard`` once no more come; fails if they continue for ``ready_within_s``."""
        deadline = time.monotonic() + self.ready_within_s
        heard = self.commands_heard(operator)
        while heard is not None:
            time.sleep(_QUIET_S)
            before, heard = heard, self.commands_heard(operator)
            if heard == before:
                break
            assert time.monotonic() < deadline, (
                f"commands still arrive after {self.ready_within_s:g} s without a send_action, "
                f"{heard} by now: what sends them does not end"
            )
        return heard

    def test_is_complete(self, operator: Any) -> None:
        assert missing_operator_methods(operator) == []
        assert getattr(type(operator), "api", None), "declare api = '1.0'"

    def test_import_is_light(self) -> None:
        module = OPERATORS.get(self.entry_point).__module__
        run = [sys.executable, "-c", _IMPORT_PROBE, module]
        found = subprocess.run(
            run, capture_output=True, text=True, check=True, timeout=_IMPORT_S
        ).stdout
        modules, threads = json.loads(found)
        assert not set(self.heavy_modules) & set(modules)
        assert threads == 1, "importing the plugin starts a thread"

    def test_constructor_names_every_parameter(self) -> None:
        signature = inspect_signature(OPERATORS.get(self.entry_point))
        assert not signature.open, (
            "*args or **kwargs that go nowhere hide names from a config check"
        )

    def test_constructor_does_no_io(self) -> None:
        refuse = mock.Mock(side_effect=AssertionError("the constructor does I/O"))
        with (
            mock.patch("socket.socket.connect", refuse),
            mock.patch("socket.socket.bind", refuse),
            mock.patch("threading.Thread.start", refuse),
            mock.patch("subprocess.Popen.__init__", refuse),
        ):
            OPERATORS.get(self.entry_point)(**self.arguments).close()

    def test_embodiment_is_valid_before_connect(self, operator: Any) -> None:
        spec = operator.embodiment
        assert isinstance(spec, EmbodimentSpec)
        assert EmbodimentSpec.from_dict(json.loads(json.dumps(spec.to_dict()))) == spec

    def test_nothing_works_before_connect(self, operator: Any) -> None:
        with pytest.raises(NotReady):
            self.frame(operator)
        middle = np.array([(j.lower + j.upper) / 2 for j in operator.embodiment.joints])
        with pytest.raises(OperatorError):
            operator.send_action(middle)

    def test_frame_matches_the_embodiment(self, connected: Any) -> None:
        spec, frame = connected.embodiment, self.frame(connected)
        assert frame.state.shape == (spec.state_dim,)
        assert frame.state.dtype == np.float64
        assert np.isfinite(frame.state).all()
        assert set(frame.images) == set(spec.camera_names)
        for camera in spec.cameras:
            image = frame.images[camera.name]
            assert image.shape == (camera.height, camera.width, 3)
            assert image.dtype == np.dtype(np.uint8)
        # What came with them, depth for one, has a stamp too.
        assert set(frame.stamps) >= {STATE, *spec.camera_names}

    def test_frames_are_fresh_arrays(self, connected: Any) -> None:
        first, second = self.frame(connected), self.frame(connected)
        pairs: list[tuple[Any, Any]] = [(first.state, second.state)]
        pairs += [(first.images[n], second.images[n]) for n in first.images]
        for a, b in pairs:
            assert not np.shares_memory(a, b), "get_frame hands out a buffer that it reuses"

    def test_stamps_go_on(self, connected: Any) -> None:
        first = self.frame(connected)
        connected.send_action(self.hold(connected))
        deadline = time.monotonic() + self.ready_within_s
        waiting = set(first.stamps)
        while waiting and time.monotonic() < deadline:
            stamps = self.frame(connected).stamps
            assert all(stamps[s] >= first.stamps[s] for s in stamps), "a stamp went back"
            waiting = {s for s in waiting if stamps[s] <= first.stamps[s]}
            time.sleep(0.02)
            if waiting:
                connected.send_action(self.hold(connected))
        assert not waiting, f"no newer reading of {sorted(waiting)} in {self.ready_within_s:g} s"

    @pytest.mark.parametrize("fault", ["nan", "inf", "short", "long", "matrix", "above", "below"])
    def test_bad_actions_are_refused(self, connected: Any, fault: str) -> None:
        good, joints = self.hold(connected), connected.embodiment.joints
        bad = {
            "nan": np.where(np.arange(len(good)) == 0, np.nan, good),
            "inf": np.where(np.arange(len(good)) == 0, np.inf, good),
            "short": good[:-1],
            "long": np.append(good, 0.0),
            "matrix": good[None],
            "above": np.array([joints[0].upper + 0.5, *good[1:]]),
            "below": np.array([joints[0].lower - 0.5, *good[1:]]),
        }[fault]
        with pytest.raises(Rejected):
            connected.send_action(bad)
        connected.send_action(good)  # a refusal leaves the operator as it was

    def test_the_action_belongs_to_the_caller(self, connected: Any) -> None:
        action = self.hold(connected)
        before = action.copy()
        connected.send_action(action)
        np.testing.assert_array_equal(action, before)

    def test_stop_works_in_any_state(self, operator: Any) -> None:
        operator.stop()
        operator.connect()
        self.first_frame(operator)
        operator.stop()
        operator.stop()
        operator.close()
        operator.stop()

    def test_a_later_stop_sends_the_arm_nothing(self, connected: Any) -> None:
        before = self.settled(connected)
        if before is None:
            pytest.skip("nobody counts commands: override commands_heard")
        connected.send_action(self.hold(connected))
        connected.stop()
        stopped = self.settled(connected)
        assert stopped is not None
        assert stopped > before, "commands_heard does not count commands"
        connected.stop()
        connected.close()
        assert self.settled(connected) == stopped, "it would throw back an arm that was moved"

    def test_stop_works_from_another_thread(self, connected: Any) -> None:
        failures: list[BaseException] = []

        def stop() -> None:
            try:
                connected.stop()
            except BaseException as error:  # noqa: BLE001 - carried to the test's own thread
                failures.append(error)

        thread = threading.Thread(target=stop, daemon=True)
        thread.start()
        thread.join(self.ready_within_s)
        assert not thread.is_alive(), f"stop did not return in {self.ready_within_s:g} s"
        assert failures == []

    def test_close_gives_everything_back(self, operator: Any) -> None:
        before = set(threading.enumerate())
        operator.connect()
        self.first_frame(operator)
        operator.close()
        operator.close()
        left = [t.name for t in threading.enumerate() if t not in before and not t.daemon]
        assert left == [], "close leaves threads behind"
        with pytest.raises(OperatorError):
            self.frame(operator)
        with pytest.raises(OperatorError):
            operator.send_action(np.zeros(operator.embodiment.dim))

    # -- the two parts of an operator that can be divided ----------------------------------------

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
        index = next(i for i, j in enumerate(spec.joints) if j.name in names)
        joint, column = spec.joints[index], names.index(spec.joints[index].name)
        step = min(_STEP, (joint.upper - joint.lower) / 4.0)
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
        control.send_action(held)
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

    def _state(self, part: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
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
