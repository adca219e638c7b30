"""A Robotiq gripper through the socket that its URCap opens on the controller.

ASCII lines on port 63352: ``GET POS`` is answered with ``POS 128``, ``SET POS 255`` with ``ack``.
The registers are those of the gripper (Robotiq, 2F-85/2F-140 instruction manual, "Control"): POS
0 (open) to 255 (closed), SPE and FOR 0 to 255, ACT and GTO switches, STA 3 when activated, FLT 0
without a fault.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time

from fluxvla_core.errors import Faulted, NotReady

PORT = 63352
ACTIVATED = 3
CLOSED = 255
# Asked this often where it is; each answer takes the controller a few milliseconds.
_POLL_S = 0.03
_TIMEOUT_S = 1.0


class RobotiqGripper:
    """A thread that talks to the gripper, so that neither commands nor readings wait for it.

    Positions are normalised: 0 closed, 1 open.

    Args:
        host: the controller.
        port: of the URCap.
        speed, force: 0 to 1 of what the gripper can.
        activate: let ``connect`` activate a gripper that is not; it opens and closes then.
        moves: whether it is commanded here. One that is only read is sent questions alone, and with
            ``activate`` it is waited for until somebody else has activated it.
    """

    def __init__(
        self,
        host: str,
        port: int = PORT,
        speed: float = 1.0,
        force: float = 0.5,
        activate: bool = False,
        moves: bool = True,
    ) -> None:
        self._address = host, port
        self._registers = {"SPE": round(speed * CLOSED), "FOR": round(force * CLOSED)}
        self._activate = activate
        self._moves = moves
        self._socket: socket.socket | None = None
        self._closing = threading.Event()
        self._wanted: int | None = None
        self._hold = False
        self._newest: tuple[float, float] | None = None
        self._problem: Faulted | None = None
        self._thread = threading.Thread(target=self._run, name="fluxvla-gripper", daemon=True)

    def connect(self, timeout_s: float) -> None:
        """Open the connection, and see that the gripper is activated.

        Raises:
            NotReady: nobody answers there, or the gripper is not activated.
            Faulted: it answers with something else, or reports a fault.
        """
        try:
            self._socket = socket.create_connection(self._address, timeout_s)
        except OSError as error:
            raise NotReady(
                f"no gripper answers on {self._address[0]}:{self._address[1]}: {error}",
                cause="the Robotiq URCap is not installed or not running on the controller",
                next="install it, or --set <URRTDEOperator>.gripper=false for an arm without one",
            ) from error
        self._socket.settimeout(_TIMEOUT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if self._get("STA") != ACTIVATED:
            self._wake(timeout_s)
        if self._moves:
            self._set(GTO=1, **self._registers)
        self._newest = time.monotonic(), self._read()
        self._thread.start()

    def position(self) -> tuple[float, float]:
        """When it was read (monotonic, s), and where the gripper is, 0 to 1.

        Raises:
            Faulted: the connection broke, or the gripper reports a fault.
        """
        if self._problem is not None:
            raise self._problem
        assert self._newest is not None, "connect() comes first"
        return self._newest

    def move(self, position: float) -> None:
        """Go to ``position``, 0 to 1; sent by the thread, the newest alone."""
        self._wanted = round((1.0 - position) * CLOSED)

    def stop(self) -> None:
        """Stay where it is, with the force that it has; what it holds it holds on to."""
        self._hold = True

    def close(self) -> None:
        """End thread and connection; any number of times."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(2 * _TIMEOUT_S)
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.close()

    def _run(self) -> None:
        sent: int | None = None
        while not self._closing.is_set():
            try:
                if self._hold:
                    self._hold, self._wanted, sent = False, None, None
                    self._set(GTO=0)
                wanted = self._wanted
                if wanted is not None and wanted != sent:
                    self._set(GTO=1, POS=wanted)
                    sent = wanted
                self._newest = time.monotonic(), self._read()
            except Faulted as problem:
                self._problem = problem
                return
            self._closing.wait(_POLL_S)

    def _wake(self, timeout_s: float) -> None:
        if not self._activate:
            raise NotReady(
                "the gripper is not activated",
                cause="it was switched off and on; to activate it opens and closes it",
                next="activate it on the teach pendant, or "
                "--set <URRTDEOperator>.activate_gripper=true",
            )
        if self._moves:
            self._set(ACT=1)
        until = time.monotonic() + timeout_s
        while self._get("STA") != ACTIVATED:
            if time.monotonic() > until:
                raise NotReady(f"the gripper is not activated after {timeout_s:g} s")
            time.sleep(_POLL_S)

    def _read(self) -> float:
        fault = self._get("FLT")
        if fault:
            raise Faulted(
                f"the gripper reports fault {fault}",
                next="the Robotiq manual explains the number; activate the gripper again",
            )
        return 1.0 - self._get("POS") / CLOSED

    def _get(self, register: str) -> int:
        answer = self._ask(f"GET {register}")
        name, _, value = answer.partition(" ")
        if name != register or not value.strip().isdigit():
            raise Faulted(f"the gripper answers {answer!r} to GET {register}")
        return int(value)

    def _set(self, **registers: int) -> None:
        words = " ".join(f"{name} {value}" for name, value in registers.items())
        answer = self._ask(f"SET {words}")
        if answer != "ack":
            raise Faulted(f"the gripper answers {answer!r} to SET {words}")

    def _ask(self, question: str) -> str:
        assert self._socket is not None
        try:
            self._socket.sendall(question.encode() + b"\n")
            # A few bytes, in one segment; whether a newline ends them depends on the release.
            answer = self._socket.recv(64)
            if not answer:
                raise ConnectionResetError("the controller closed the connection")
        except OSError as error:
            raise Faulted(f"the connection to the gripper broke: {error}") from error
        return answer.decode("ascii", "replace").strip()
