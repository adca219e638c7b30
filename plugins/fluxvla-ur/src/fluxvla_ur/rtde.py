"""Universal Robots without ROS: the Real-Time Data Exchange interface, through ``ur-rtde``.

``ur-rtde`` (PyPI, MIT) speaks RTDE with the controller on port 30004 and has it run a script that
obeys ``servoj``; the gripper is reached through its own socket, cameras through OpenCV.

Parameters of ``servoJ`` as its documentation has them (and URScript's of ``servoj``): a command
controls the arm for ``time`` seconds, ``lookahead_time`` (0.03 to 0.2 s) smooths the path and
``gain`` (100 to 2000) is how stiffly it is followed; its speed and acceleration are not used.
"""

from __future__ import annotations

import logging
import math
import socket
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import ConfigError, Faulted, NotReady
from fluxvla_core.operators import Camera, Frame, Operator, Part
from fluxvla_core.ros2 import STATE, checked_action
from fluxvla_ur.embodiment import ACCELERATION, JOINTS, RATE_HZ, ur_spec
from fluxvla_ur.readiness import check_age, check_not_paused, check_safety, script_ended
from fluxvla_ur.robotiq import PORT as GRIPPER_PORT
from fluxvla_ur.robotiq import RobotiqGripper
from fluxvla_ur.rtde_client import Reading, disconnect, import_rtde, wait_for, within
from fluxvla_ur.video import VideoCamera

Array = npt.NDArray[np.float64]
log = logging.getLogger("fluxvla.ur")
_ARM = len(JOINTS)
_RTDE_PORT = 30004
# What is asked of the controller; the recipe's order is the client's business.
_VARIABLES = [
    "timestamp",
    "actual_q",
    "robot_mode",
    "safety_mode",
    "safety_status_bits",
    "runtime_state",
    "speed_scaling",
    "target_speed_fraction",
]
# As often as is looked; the controller could send at 500 Hz, which costs this machine a core.
_DATA_HZ = 125.0
# The client waits for the controller's answer for ever: how long that may take while the controller
# speaks, and once it fell silent.
_STOP_S, _DISCONNECT_S, _SILENT_S = 2.0, 4.0, 0.3


class URRTDEOperator(Operator):
    """A UR arm on the network, without ROS.

    The controller is configured to stop by itself when this program falls silent (``watchdog_hz``).
    Protective and emergency stops end the commands, and the speed slider slows them down.

    An arm with a gripper can be divided between two processes. The controller sends its data to
    several clients; so must the gripper's URCap answer several, as it does programs on the
    controller (not tried on a real one). Without a gripper the arm cannot be divided: the gripper's
    number is what it was last sent, which the process that reads the cameras does not know.

    Args:
        robot_ip: address of the controller.
        model: ``ur3e``, ``ur5e`` or ``ur10e``.
        publish_rate: commands a second.
        cameras: name -> device number, path or URL, in the order of the images.
        height, width: of every image, in pixels.
        gripper: whether there is a Robotiq gripper behind its URCap; without one the gripper's
            number is what it was last sent.
        gripper_port, gripper_speed, gripper_force: of the gripper, the last two 0 to 1.
        activate_gripper: let ``connect`` activate it if it is not; it opens and closes then.
        lookahead_time: of ``servoJ``, 0.03 to 0.2 s.
        gain: of ``servoJ``, 100 to 2000.
        watchdog_hz: the controller stops the arm when it hears less often than this.
        connect_timeout_s: how long ``connect`` waits for each part of the robot.
        max_age_s: how long a stream may be silent, checked at every command. Not
            ``safety.max_age_s``: how old an observation may be when the policy is queried.

    Raises:
        ConfigError: an unknown model, or a value out of its range.
    """

    api: ClassVar[str] = "1.0"

    def __init__(
        self,
        robot_ip: str,
        model: str = "ur5e",
        publish_rate: float = RATE_HZ,
        cameras: Mapping[str, int | str] | None = None,
        height: int = 480,
        width: int = 640,
        gripper: bool = True,
        gripper_port: int = GRIPPER_PORT,
        gripper_speed: float = 1.0,
        gripper_force: float = 0.5,
        activate_gripper: bool = False,
        lookahead_time: float = 0.1,
        gain: float = 300.0,
        watchdog_hz: float = 5.0,
        connect_timeout_s: float = 10.0,
        max_age_s: float = 0.5,
    ) -> None:
        ranges = {
            "lookahead_time": (lookahead_time, 0.03, 0.2),
            "gain": (gain, 100.0, 2000.0),
            "gripper_speed": (gripper_speed, 0.0, 1.0),
            "gripper_force": (gripper_force, 0.0, 1.0),
            "watchdog_hz": (watchdog_hz, 1.0, 100.0),
            "connect_timeout_s": (connect_timeout_s, 0.1, 600.0),
            "max_age_s": (max_age_s, 0.01, 60.0),
        }
        for name, (value, least, most) in ranges.items():
            if not least <= value <= most:
                raise ConfigError(f"{name} is from {least:g} to {most:g}, got {value!r}")
        self._sources = dict(cameras or {})
        try:
            seen = tuple(Camera(name, height, width) for name in self._sources)
            self.embodiment = ur_spec(model, seen, publish_rate)
        except ValueError as error:
            raise ConfigError(f"URRTDEOperator: {error}") from error
        self.robot_ip = robot_ip
        self._gripper_settings = gripper_port, gripper_speed, gripper_force, activate_gripper
        self._has_gripper = gripper
        self._part = Part.WHOLE
        self._servo = lookahead_time, gain
        self._watchdog_hz = watchdog_hz
        self._connect_timeout = connect_timeout_s
        self._max_age = max_age_s
        # Re-entrant: a signal handler may call stop() in the thread that is sending.
        self._lock = threading.RLock()
        self._opening = threading.Lock()
        self._closing = threading.Event()
        self._control: Any = None
        self._receive: Any = None
        self._gripper: RobotiqGripper | None = None
        self._cameras: list[VideoCamera] = []
        self._watcher: threading.Thread | None = None
        self._newest: Reading | None = None
        self._last: Array | None = None
        self._spoke = 0.0
        self._moving = False
        # The client reconnects by itself and starts its script again, without the watchdog and
        # without anybody's asking; what was lost once is not trusted again before ``connect``.
        self._broken = False

    # Methods of the Operator contract.

    def without_cameras(self) -> URRTDEOperator | None:
        """This operator, to be connected without its cameras; None without a gripper.

        Raises:
            Rejected: it is connected, or was made the other part.
        """
        return self._divided(Part.WITHOUT_CAMERAS)

    def without_commands(self) -> URRTDEOperator | None:
        """This operator, to be connected for reading alone: no script, no watchdog, a gripper that
        is only asked; None without a gripper.

        Raises:
            Rejected: it is connected, or was made the other part.
        """
        return self._divided(Part.WITHOUT_COMMANDS)

    def connect(self) -> None:
        """Open every connection and wait until all parts speak; nothing if it is open.

        Raises:
            LoadFailed: ``ur-rtde`` or OpenCV is not installed.
            NotReady: the controller, the gripper or a camera does not answer, or is not ready.
            Faulted: a stop is active, or what answers is something else.
        """
        # Its own lock: stop() must never wait for a robot that does not answer.
        with self._opening:
            if self._is_open:
                return
            control, receive = import_rtde()
            self._closing = threading.Event()
            self._newest, self._last, self._moving = None, None, False
            self._broken = False
            try:
                self._open(control, receive)
            except BaseException:
                self._release()
                raise

    def get_state(self) -> Array:
        """``(7,)`` where the arm is (rad) and the gripper (0 closed, 1 open), without waiting.

        Raises:
            NotReady: not connected.
            Stale: the controller or the gripper is silent.
            Faulted: the gripper reports a fault.
        """
        return np.append(self._reading().joints, self._gripper_position()[1])

    def state_stamp(self) -> float:
        """When the older of arm's and gripper's newest reading arrived, on the monotonic clock.

        Raises:
            NotReady: not connected.
            Stale: the controller or the gripper is silent.
            Faulted: the gripper reports a fault.
        """
        return min(self._reading().receipt, self._gripper_position()[0])

    @property
    def last_action(self) -> Array | None:
        """``(7,)`` what holds arm and gripper, None before any command.

        ``servoStop`` leaves the arm where it comes to rest, not at its last command.
        """
        with self._lock:
            last = self._last
            if last is None or self._control is None:
                return None
            return last.copy() if self._moving else np.append(self._reading().joints, last[_ARM])

    @property
    def speed_scaling(self) -> float:
        """Share of the programmed speed that the robot runs at, 0 to 1."""
        return self._reading().scaling

    def get_frame(self) -> Frame:
        """State and the newest images, in fresh arrays, with their receipt stamps.

        Raises:
            NotReady: not connected, or the part without cameras.
            Stale: a stream is silent.
            BadMessage: images have another size.
            Faulted: the gripper reports a fault.
        """
        reading, gripper = self._reading(), self._gripper_position()
        self._part.check_cameras(self.embodiment.name)
        images, stamps = {}, {STATE: min(reading.receipt, gripper[0])}
        for camera in self._cameras:
            newest = camera.newest()
            receipt = None if newest is None else newest[0]
            check_age(camera.camera.name, receipt, self._max_age)
            assert newest is not None
            stamps[camera.camera.name], images[camera.camera.name] = newest[0], newest[1].copy()
        return Frame(np.append(reading.joints, gripper[1]), images, stamps)

    def send_action(self, action: npt.ArrayLike) -> None:
        """``servoJ`` to one ``(7,)`` command.

        Raises:
            Rejected: wrong shape, not finite, or outside the limits; before anything is sent. Or
                this is the part without commands.
            NotReady: not connected.
            Stale: the controller is silent.
            Faulted: the robot cannot move (a stop, a pause, its program ended).
        """
        self._part.check_commands(self.embodiment.name)
        checked = checked_action(self.embodiment, action)
        with self._lock:
            reading = self._reading()
            check_safety(reading.safety)
            check_not_paused(reading.scaling)
            if not self._listens():
                raise self._not_obeying()
            period = 1.0 / self.embodiment.rate_hz
            lookahead, gain = self._servo
            target = checked[:_ARM].tolist()
            try:
                obeyed = self._control.servoJ(target, 0.0, 0.0, period, lookahead, gain)
            except RuntimeError as error:
                # The client looks for a controller that it loses within the call, in vain.
                self._broken = True
                raise self._not_obeying() from error
            if not obeyed:
                raise self._not_obeying()
            self._spoke, self._moving, self._last = time.monotonic(), True, checked
            if self._gripper is not None:
                self._gripper.move(float(checked[_ARM]))

    def stop(self) -> None:
        """Come to rest within the acceleration limit and hold.

        Any state, any thread, any number of times. What fails is logged, not raised: the caller is
        ending a motion for another reason.
        """
        with self._lock:
            if self._control is None:
                return
            steps: list[Callable[[], object]] = []
            if self._moving and self._listens():
                steps.append(self._stop_servo)
            self._moving = False
            if self._gripper is not None and self._last is not None:
                steps.append(self._gripper.stop)
            for step in steps:
                try:
                    step()
                except Exception as error:  # noqa: BLE001 - the other steps must still be taken
                    log.error("%s: stopping failed: %s", self.embodiment.name, error)

    def close(self) -> None:
        """Stop, then give everything back; any number of times."""
        with self._lock:
            if not self._is_open:
                return
            self.stop()
            self._closing.set()
        if self._watcher is not None:
            self._watcher.join(2.0)
        with self._lock:
            self._release()

    # Private methods.

    def _divided(self, part: Part) -> URRTDEOperator | None:
        if not self._has_gripper:
            return None
        self._part = self._part.divided(part, self._is_open, self.embodiment.name)
        return self

    @property
    def _is_open(self) -> bool:
        """Whether the arm can be commanded, or in the part without commands, be read."""
        return (self._control if self._part.commands else self._receive) is not None

    def _open(self, control: Any, receive: Any) -> None:
        timeout = self._connect_timeout
        try:
            # The client would wait for minutes for an address that does not answer.
            socket.create_connection((self.robot_ip, _RTDE_PORT), timeout).close()
            self._receive = receive.RTDEReceiveInterface(self.robot_ip, _DATA_HZ, _VARIABLES)
            self._watcher = threading.Thread(target=self._watch, name="fluxvla-rtde", daemon=True)
            self._watcher.start()
            wait_for(lambda: self._newest is not None, "the controller sends no data", timeout)
            assert self._newest is not None
            if self._part.commands:
                check_safety(self._newest.safety)
                self._control = control.RTDEControlInterface(self.robot_ip, _DATA_HZ)
                running = self._control.isProgramRunning
                wait_for(running, "the control script does not run", timeout)
        except (OSError, RuntimeError) as error:
            raise NotReady(
                f"no UR controller can be used at {self.robot_ip}: {error}",
                cause="it is off, has another address, or is not in remote control",
                next="ping it, power the arm on, and switch the teach pendant to Remote Control",
            ) from error
        port, speed, force, activate = self._gripper_settings
        if self._has_gripper:
            moves = self._part.commands
            self._gripper = RobotiqGripper(self.robot_ip, port, speed, force, activate, moves)
            self._gripper.connect(timeout)
        for camera in self.embodiment.cameras if self._part.cameras else ():
            self._cameras.append(VideoCamera(camera, self._sources[camera.name]))
            self._cameras[-1].connect()
        for camera in self._cameras:
            wait_for(
                lambda c=camera: c.newest() is not None, f"{camera.camera.name} is dark", timeout
            )
        if self._part.commands:
            # Last: from here on the controller wants to hear from us.
            self._control.setWatchdog(self._watchdog_hz)
            self._spoke = time.monotonic()

    def _watch(self) -> None:
        """Keep the newest reading and its receipt; keep the watchdog quiet between commands."""
        stamp, closing = math.nan, self._closing
        while not closing.wait(1.0 / _DATA_HZ):
            receive, now = self._receive, time.monotonic()
            try:
                # A client that lost its controller keeps returning the last state it received.
                if receive is not None and receive.getTimestamp() != stamp:
                    stamp = receive.getTimestamp()
                    self._newest = Reading.newest(receive, now)
                self._kick(now)
            except Exception as error:  # noqa: BLE001 - its silence is what is noticed
                log.error("%s: reading failed: %s", self.embodiment.name, error)

    def _kick(self, now: float) -> None:
        # While the controller is silent its watchdog is left to stop the arm.
        due = self._spoke and now - self._spoke > 0.4 / self._watchdog_hz and not self._silent()
        if self._lock.acquire(blocking=False):
            try:
                # Looked at even if not due: a connection may be lost and back between commands.
                if self._control is not None and self._listens() and due:
                    # With the lock held: stop() must not wait for a controller that fell silent.
                    self._broken = not within(self._max_age, self._control.kickWatchdog)
                    self._spoke = now
            finally:
                self._lock.release()

    def _reading(self) -> Reading:
        if not self._is_open:
            raise NotReady(f"{self.embodiment.name} is not connected", next="call connect() first")
        reading = self._newest
        check_age("controller", None if reading is None else reading.receipt, self._max_age)
        assert reading is not None
        return reading

    def _gripper_position(self) -> tuple[float, float]:
        if self._gripper is None:
            last = 1.0 if self._last is None else float(self._last[_ARM])
            return time.monotonic(), last
        position = self._gripper.position()
        check_age("gripper", position[0], self._max_age)
        return position

    def _silent(self) -> bool:
        reading = self._newest
        return reading is None or time.monotonic() - reading.receipt > self._max_age

    def _stop_servo(self) -> None:
        stop = partial(self._control.servoStop, ACCELERATION)
        if not within(_SILENT_S if self._silent() else _STOP_S, stop):
            # The call still waits, in its thread, and the client takes one at a time.
            self._broken = True
            log.error(
                "%s: the controller does not answer; its watchdog stops the arm", self.robot_ip
            )

    def _listens(self) -> bool:
        """Whether a call reaches the script; without a connection the client would crash."""
        self._broken = self._broken or not self._control.isConnected()
        return not self._broken and bool(self._control.isProgramRunning())

    def _not_obeying(self) -> Faulted:
        # The two connections report a stop a cycle apart; its cause explains more than the script's
        # end.
        time.sleep(2.0 / _DATA_HZ)
        if self._newest is not None:
            check_safety(self._newest.safety)
        return script_ended(self._watchdog_hz)

    def _release(self) -> None:
        self._closing.set()
        for camera in self._cameras:
            camera.close()
        if self._gripper is not None:
            self._gripper.close()
        control, receive = self._control, self._receive
        self._control = self._receive = self._gripper = None
        self._cameras, self._spoke = [], 0.0
        if control is None and receive is None:
            return
        seconds = _SILENT_S if self._broken or self._silent() else _DISCONNECT_S
        if not within(seconds, partial(disconnect, control, receive)):
            log.error("%s: the connection does not end; it will with the program", self.robot_ip)
