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
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar
from unittest import mock

import numpy as np
import pytest

from fluxvla_core.config.runtime_signature import inspect_signature
from fluxvla_core.contracts.check import missing_operator_methods
from fluxvla_core.contracts.frame import STATE
from fluxvla_core.contracts.robot import Operator
from fluxvla_core.errors import NotReady, OperatorError, Rejected
from fluxvla_core.plugins.registry import OPERATORS, PLUGIN_FILE
from fluxvla_core.spec import EmbodimentSpec
from fluxvla_core.testing._operator_parts import STEP, Array, DividedOperatorChecks, not_followed

# An arm is at rest that moves less than this, in its unit, in the time of so many commands.
_AT_REST, _STILL = STEP / 10.0, 5
# How far a stamp may lie ahead of a clock that was read after it: none, but for rounding.
_AHEAD_S = 0.01
_DAY_S = 86400.0
_FAULTS = {
    "nan": "not a number",
    "inf": "not finite",
    "short": "a number short",
    "long": "a number too long",
    "matrix": "a row of a matrix",
    "above": "above the limit of its first joint",
    "below": "below the limit of its first joint",
}
# How long importing a plugin in a new process may take.
_IMPORT_S = 120.0
_IMPORT_PROBE = """
import importlib, json, sys, threading
importlib.import_module(sys.argv[1])
print(json.dumps([sorted({m.partition(".")[0] for m in sys.modules}), threading.active_count()]))
"""


class OperatorConformance(DividedOperatorChecks):
    """Inherit, set ``entry_point`` and ``arguments``, and run pytest."""

    entry_point: ClassVar[str]
    """The operator's ``type`` in a config."""
    arguments: ClassVar[Mapping[str, Any]] = {}
    """Constructor arguments that reach the robot or its stand-in."""
    heavy_modules: ClassVar[tuple[str, ...]] = ("torch", "rclpy")
    """Modules that importing the plugin may not pull in."""
    ready_within_s: ClassVar[float] = 10.0
    """How long each wait of the tests may take: for a first frame, for newer readings, for the end
    of commands after a stop, for a joint to come to its target."""
    frame_within_s: ClassVar[float] = 1.0
    """How long one ``get_frame`` may take, the middle one of several."""

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

    def test_is_complete(self, operator: Any) -> None:
        lacks = missing_operator_methods(operator)
        assert not lacks, (
            f"{self.entry_point} lacks {', '.join(lacks)}, or they take other arguments than the "
            "core passes: an operator of the full contract can be driven by every runner"
        )
        api = getattr(type(operator), "api", None)
        assert api, (
            f"{self.entry_point}.api is {api!r}, expected '1.0': the version of the contract that "
            "it is written for, by which a later core refuses it in words"
        )

    def test_import_is_light(self) -> None:
        module = OPERATORS.get(self.entry_point).__module__
        if module.startswith(PLUGIN_FILE):
            pytest.skip(f"{module} is known to this process alone: there is nothing to import")
        run = [sys.executable, "-c", _IMPORT_PROBE, module]
        found = subprocess.run(
            run, capture_output=True, text=True, check=True, timeout=_IMPORT_S
        ).stdout
        modules, threads = json.loads(found)
        heavy = sorted(set(self.heavy_modules) & set(modules))
        assert not heavy, (
            f"importing {module} imports {', '.join(heavy)}, expected neither: import them in "
            "connect(), because a robot's onboard computer may not have them"
        )
        assert threads == 1, (
            f"importing {module} starts {threads - 1} thread(s), expected none before connect(): "
            "a config is checked without a robot"
        )

    def test_constructor_names_every_parameter(self) -> None:
        signature = inspect_signature(OPERATORS.get(self.entry_point))
        assert not signature.open, (
            f"{self.entry_point}() takes *args or **kwargs that go nowhere, expected every "
            "parameter by name: config check finds misspelt keys by them"
        )

    def test_constructor_does_no_io(self) -> None:
        refuse = mock.Mock(
            side_effect=AssertionError(
                f"{self.entry_point}() opens a socket, starts a thread or a process, expected no "
                "I/O before connect(): a config is checked without a robot"
            )
        )
        with (
            mock.patch("socket.socket.connect", refuse),
            mock.patch("socket.socket.bind", refuse),
            mock.patch("threading.Thread.start", refuse),
            mock.patch("subprocess.Popen.__init__", refuse),
        ):
            OPERATORS.get(self.entry_point)(**self.arguments).close()

    def test_embodiment_is_valid_before_connect(self, operator: Any) -> None:
        spec = operator.embodiment
        assert isinstance(spec, EmbodimentSpec), (
            f"embodiment is a {type(spec).__name__} before connect(), expected an EmbodimentSpec: "
            "policy and robot are compared before anything is connected"
        )
        again = EmbodimentSpec.from_dict(json.loads(json.dumps(spec.to_dict())))
        assert again == spec, (
            f"embodiment is {again} after a way through JSON, expected {spec}: it is compared with "
            "that of checkpoints, which have it as JSON"
        )

    def test_nothing_works_before_connect(self, operator: Any) -> None:
        assert self._refused(lambda: self.frame(operator), NotReady), (
            "get_frame() gave a frame before connect(), expected NotReady: it would be an old one"
        )
        middle = np.array([(j.lower + j.upper) / 2 for j in operator.embodiment.joints])
        assert self._refused(lambda: operator.send_action(middle), OperatorError), (
            "send_action() took a command before connect(), expected NotReady: the run would go on "
            "as if the arm had it"
        )

    def test_frame_matches_the_embodiment(self, connected: Any) -> None:
        spec, frame = connected.embodiment, self.frame(connected)
        assert frame.state.shape == (spec.state_dim,), (
            f"get_frame().state has the shape {frame.state.shape}, expected ({spec.state_dim},): "
            f"one number for each of {', '.join(spec.state_names)}"
        )
        assert frame.state.dtype == np.float64, (
            f"get_frame().state is {frame.state.dtype}, expected float64: it is compared with "
            "limits at that precision"
        )
        assert np.isfinite(frame.state).all(), (
            f"get_frame().state is {frame.state.tolist()}, expected finite numbers: the safety "
            "stops the robot at the first that is not"
        )
        assert set(frame.images) == set(spec.camera_names), (
            f"get_frame().images has {sorted(frame.images)}, expected {sorted(spec.camera_names)}, "
            "the cameras of the embodiment: policies ask for them by name"
        )
        for camera in spec.cameras:
            image, shape = frame.images[camera.name], (camera.height, camera.width, 3)
            assert image.shape == shape, (
                f"the image of {camera.name} has the shape {image.shape}, expected {shape}: "
                "height, width and three colours, as the embodiment says"
            )
            assert image.dtype == np.dtype(np.uint8), (
                f"the image of {camera.name} is {image.dtype}, expected uint8 from 0 to 255"
            )
        # What came with them, depth for one, has a stamp too.
        lacks = {STATE, *spec.camera_names} - set(frame.stamps)
        assert not lacks, (
            f"get_frame().stamps lacks {sorted(lacks)}, expected the time of every reading: by it "
            "a stream that has stopped is noticed"
        )

    def test_frames_are_fresh_arrays(self, connected: Any) -> None:
        first, second = self.frame(connected), self.frame(connected)
        pairs: list[tuple[Any, Any]] = [(first.state, second.state)]
        pairs += [(first.images[n], second.images[n]) for n in first.images]
        for a, b in pairs:
            assert not np.shares_memory(a, b), (
                "two frames share memory, expected fresh arrays: a frame is kept while the next "
                "is read, for recordings and the policy's thread"
            )

    def test_frames_come_at_once(self, connected: Any) -> None:
        taken = []
        for _ in range(5):
            start = time.monotonic()
            self.frame(connected)
            taken.append(time.monotonic() - start)
        middle = float(np.median(taken))
        assert middle < self.frame_within_s, (
            f"get_frame() took {middle:.3g} s, expected less than {self.frame_within_s:g} s: it "
            "gives the newest reading and waits for none, because the arm is held meanwhile"
        )

    def test_stamps_go_on(self, connected: Any) -> None:
        first = self.frame(connected)
        connected.send_action(self.hold(connected))
        deadline = time.monotonic() + self.ready_within_s
        waiting = set(first.stamps)
        while waiting and time.monotonic() < deadline:
            stamps = self.frame(connected).stamps
            back = [s for s in stamps if stamps[s] < first.stamps[s]]
            assert not back, (
                f"the stamp of {', '.join(back)} went back, expected times that go on: the age of "
                "a reading follows from them"
            )
            waiting = {s for s in waiting if stamps[s] <= first.stamps[s]}
            time.sleep(0.02)
            if waiting:
                connected.send_action(self.hold(connected))
        assert not waiting, (
            f"no newer reading of {sorted(waiting)} came in {self.ready_within_s:g} s, expected "
            "stamps that go on with the readings: the safety stops a robot whose readings are old"
        )

    def test_stamps_are_of_its_clock(self, connected: Any) -> None:
        clock = Operator.adapt(connected).clock
        stamps = self.frame(connected).stamps
        now = time.monotonic() if clock is None else clock.now()
        name = "time.monotonic()" if clock is None else "clock.now()"
        for stream, stamp in stamps.items():
            hint = " (it is that of time.time())" if abs(stamp - time.time()) < _DAY_S else ""
            assert -_AHEAD_S <= now - stamp <= self.ready_within_s + _AHEAD_S, (
                f"the stamp of {stream} is {stamp:.6g}{hint}, expected a time shortly before "
                f"{now:.6g} of {name}: the age of a reading is the difference, and a clock that a "
                "network sets may jump"
            )

    def test_a_command_moves_its_own_joint(self, connected: Any) -> None:
        """One after the other each joint goes a small way, and its column of the state follows."""
        operator = Operator.adapt(connected)
        spec = operator.embodiment
        if not operator.follows_commands:
            pytest.skip("follows_commands is False: this arm does not do what it is sent")
        if spec.action_mode != "absolute":
            pytest.skip(f"actions are {spec.action_mode}: there is no target to compare with")
        base = operator.last_action
        base = self.hold(connected) if base is None else np.array(base)
        for index, joint in enumerate(spec.joints):
            if joint.name in spec.state_names and not joint.by_speed:
                self._nudge(connected, base, index)

    def _nudge(self, connected: Any, base: Array, index: int) -> None:
        """Joint ``index`` goes a small way from ``base`` and back."""
        spec = connected.embodiment
        joint, column = spec.joints[index], spec.state_names.index(spec.joints[index].name)
        before = self._at_rest(connected, base)  # an arm gives way to its weight first
        step = min(STEP, (joint.upper - joint.lower) / 4.0)
        step = step if joint.upper - base[index] >= base[index] - joint.lower else -step
        target = base.copy()
        target[index] += step
        moved = np.zeros(spec.state_dim)

        def followed() -> bool:
            nonlocal moved
            self._send(connected, target)
            moved = self.frame(connected).state - before
            others = np.delete(moved, column)
            near = abs(moved[column] - step) <= abs(step) / 2.0
            return bool(near and (np.abs(others) <= abs(step) / 2.0).all())

        self._until(followed, lambda: not_followed(spec, column, step, moved))

        def returned() -> bool:
            # Commands and readings may be under way for a while: only this shows that it is back.
            nonlocal moved
            self._send(connected, base)
            moved = self.frame(connected).state - before
            return bool(abs(moved[column]) <= abs(step) / 4.0)

        self._until(
            returned,
            lambda: (
                f"send_action() moves {joint.name} back to where it was, and after "
                f"{self.ready_within_s:g} s its state is {moved[column]:.4g} from there, expected "
                "it to be back: the state follows the commands"
            ),
        )

    def _at_rest(self, connected: Any, base: Array) -> Array:
        """The state at the command ``base``, once it no longer changes, if it comes to that."""
        deadline = time.monotonic() + self.ready_within_s
        apart = _STILL / connected.embodiment.rate_hz
        last = self.frame(connected)
        while True:
            self._send(connected, base)
            frame = self.frame(connected)
            late = time.monotonic() > deadline
            if frame.stamps[STATE] - last.stamps[STATE] < apart and not late:
                continue  # the same reading, or one too soon after it
            if late or np.abs(frame.state - last.state).max() < _AT_REST:
                return frame.state
            last = frame

    def _send(self, connected: Any, action: Array) -> None:
        """One command, at the rate of the robot."""
        connected.send_action(action)
        if Operator.adapt(connected).clock is None:
            time.sleep(1.0 / connected.embodiment.rate_hz)

    @pytest.mark.parametrize("fault", list(_FAULTS))
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
        before = self.settled(connected)
        assert self._refused(lambda: connected.send_action(bad), Rejected), (
            f"send_action() took {bad.tolist()}, which is {_FAULTS[fault]}, expected Rejected at "
            "once: the call that sends it is the one that can be told"
        )
        after = self.settled(connected)
        assert after == before, (
            f"send_action() raised Rejected for {bad.tolist()}, and {after} commands were heard, "
            f"expected {before} as before: it was sent before it was refused"
        )
        connected.send_action(good)  # a refusal leaves the operator as it was

    def test_the_action_belongs_to_the_caller(self, connected: Any) -> None:
        action = self.hold(connected)
        before = action.copy()
        connected.send_action(action)
        assert np.array_equal(action, before), (
            f"send_action() changed the action that it was given from {before.tolist()} to "
            f"{action.tolist()}, expected it untouched: it is a row of the chunk"
        )

    def test_stop_works_in_any_state(self, operator: Any) -> None:
        self._stop(operator, "before connect()")
        operator.connect()
        self.first_frame(operator)
        self._stop(operator, "after connect()")
        self._stop(operator, "after a stop()")
        operator.close()
        self._stop(operator, "after close()")

    def _stop(self, operator: Any, when: str) -> None:
        problem = ""
        try:
            operator.stop()
        except Exception as error:  # noqa: BLE001 - said in the assertion
            problem = f"{type(error).__name__}: {error}"
        assert not problem, (
            f"stop() {when} raised {problem}; expected it to work in any state: whatever has gone "
            "wrong, a stop follows"
        )

    def test_a_later_stop_sends_the_arm_nothing(self, connected: Any) -> None:
        before = self.settled(connected)
        if before is None:
            pytest.skip(
                "nobody counts commands: override commands_heard in a test of the plugin, and name "
                "its file with fluxvla plugins check --kit FILE"
            )
        connected.send_action(self.hold(connected))
        connected.stop()
        more = self._hears_more(connected, before)
        stopped = self.settled(connected)
        assert stopped is not None, "commands_heard() gave None after a number"
        assert more, (
            f"commands_heard() is {stopped} after a command, as before it, expected more: it does "
            "not count commands"
        )
        connected.stop()
        connected.close()
        after = self.settled(connected)
        assert after == stopped, (
            f"a second stop() and close() sent {(after or 0) - stopped} command(s), expected none "
            "without a send_action() since: they would throw back an arm that was moved"
        )

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
        assert not failures, (
            f"stop() raised {failures} in another thread, expected it to work in any: a watchdog "
            "calls it"
        )

    def test_close_gives_everything_back(self, operator: Any) -> None:
        before = set(threading.enumerate())
        operator.connect()
        self.first_frame(operator)
        operator.close()
        operator.close()
        left = [t.name for t in threading.enumerate() if t not in before and not t.daemon]
        assert not left, (
            f"after close() the threads {', '.join(left)} still run, expected them ended: the "
            "process would never end"
        )
        assert self._refused(lambda: self.frame(operator), OperatorError), (
            "get_frame() gave a frame after close(), expected NotReady: it would be an old one"
        )
        middle = np.zeros(operator.embodiment.dim)
        assert self._refused(lambda: operator.send_action(middle), OperatorError), (
            "send_action() took a command after close(), expected NotReady: nobody would stop it"
        )
