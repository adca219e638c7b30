"""What ``fluxvla run`` plays in the faults of two processes: an arm, a policy, a hook, and harm.

The program imports this module by ``--plugin``, its control process for the arm's class. It does
what a line of the pipe ``orders`` names, one of ``HARMS``, and stores in the file ``PROVOKED`` when
that began.
"""

from __future__ import annotations

import ctypes
import logging
import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._robot_faults import ARM, Array, BenchArm, Swing
from fluxvla_core import BaseInferenceRunner, Frame, Operator
from fluxvla_core.plugins.registry import HOOKS, OPERATORS, POLICIES, RUNNERS
from fluxvla_core.robot.process.link import Link
from fluxvla_core.ros2.streams import Ring

PROVOKED, SENT, FLOOD = "provoked", "sent", "flood"
# Of ``WholeArm``: what it received and when, and what its next ``get_frame`` is to do.
RECEIVED, BLOCK, KEEP = "received", "block", "keep"
# How long what blocks does so: longer than any rule waits, and shorter than a person.
BLOCKED_S = 5.0
# Lengths of a driver's warnings that fill what the processes share in a second, to the last byte.
FLOOD_BYTES = (100_000, 10_000, 1000, 100, 1)
DRIVER = logging.getLogger("driver")


# Beside ten busy processes Fast DDS freezes within seconds, beside three hardly ever.
COMPETITORS, COMPETING_S = 10, 20.0
FROZEN_S, PATIENCE_S = 2.0, 10.0
FULL_SIZE = replace(ARM, cameras=tuple(replace(c, height=480, width=640) for c in ARM.cameras))


@RUNNERS.register_module()
class ProgramRunner(BaseInferenceRunner):
    """Under a name that a config can have."""


@OPERATORS.register_module()
class ProgramArm(BenchArm):
    """Stores every command that it sends, and writes long warnings while ``FLOOD`` is there."""

    def __init__(self, folder: str, **settings: float) -> None:
        super().__init__(**settings)
        self._flood = Path(folder) / FLOOD
        # Without a buffer: what was sent before a kill is there.
        self._file = open(Path(folder) / SENT, "ab", buffering=0)  # noqa: SIM115

    def publish_action(self, action: Array) -> None:
        self._file.write(np.asarray(action, np.float64).tobytes())
        super().publish_action(action)
        if self._flood.exists():
            for length in FLOOD_BYTES:
                DRIVER.warning("x" * length)


@OPERATORS.register_module()
class PatientArm(ProgramArm):
    """Its streams may be late, as they are while the machine stands still."""

    def __init__(self, folder: str) -> None:
        super().__init__(folder, max_age_s=PATIENCE_S, max_skew_s=PATIENCE_S)


@OPERATORS.register_module()
class FullSizeArm(PatientArm):
    """Its images have the size of a usual camera's, more than a packet."""

    embodiment = FULL_SIZE


@OPERATORS.register_module()
class WholeArm(Operator):
    """In one process, of the old shape: it cannot be divided, and its state comes with images.

    Follows at once, and stores every command and when it came. ``get_frame`` does harm while
    ``BLOCK`` or ``KEEP`` is there.
    """

    api = "1.0"
    embodiment = ARM

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder)

    def connect(self) -> None:
        self._pose = np.array([0.0, 0.0, 0.5])
        # Without a buffer: what was sent before a kill is there.
        self._sent = open(self._folder / SENT, "ab", buffering=0)  # noqa: SIM115
        self._received = open(self._folder / RECEIVED, "ab", buffering=0)  # noqa: SIM115

    def get_frame(self) -> Frame:
        for name, harm in ((BLOCK, lambda: time.sleep(BLOCKED_S)), (KEEP, keep_interpreter)):
            if (self._folder / name).exists():
                (self._folder / name).unlink()
                (self._folder / PROVOKED).write_text(str(time.monotonic()))
                harm()
        now = time.monotonic()
        images = {c.name: np.zeros((c.height, c.width, 3), np.uint8) for c in ARM.cameras}
        return Frame(self._pose.copy(), images, dict.fromkeys(("state", *images), now))

    def send_action(self, action: Array) -> None:
        self._pose = np.array(action, np.float64)
        self._sent.write(self._pose.tobytes())
        self._received.write(np.array([time.monotonic(), *action], np.float64).tobytes())

    def stop(self) -> None:
        """It rests where its last command is."""

    def close(self) -> None:
        """The files end with the process."""


@POLICIES.register_module()
class HarmfulSwing(Swing):
    """Swings, until somebody types what harm it is to do."""

    def __init__(self, folder: str, orders: int) -> None:
        super().__init__()
        self.folder, self.orders = Path(folder), orders
        self.blocks = False
        HarmfulSwing.made = self
        threading.Thread(target=self._obey, name="orders", daemon=True).start()

    def begun(self) -> None:
        """The harm begins now."""
        (self.folder / PROVOKED).write_text(str(time.monotonic()))

    def _obey(self) -> None:
        with os.fdopen(self.orders, encoding="utf-8") as lines:
            for line in lines:
                HARMS[line.strip()](self)


@HOOKS.register_module()
class BlockingHook:
    """Blocks the thread that it is called in, once the policy asks for it."""

    def action_sent(self, action: Array) -> None:
        policy = HarmfulSwing.made
        if policy.blocks:
            policy.blocks = False
            policy.begun()
            time.sleep(BLOCKED_S)


def in_policy(harm: Callable[[], object]) -> Callable[[HarmfulSwing], None]:
    """Done in the policy's next answer, and once."""

    def provoke(policy: HarmfulSwing) -> None:
        def spoil(chunk: Array) -> Array:
            policy.spoil = None
            policy.begun()
            harm()
            return chunk

        policy.spoil = spoil

    return provoke


def keep_interpreter() -> None:
    """Native code that computes in one piece: PyDLL, unlike CDLL, holds the GIL."""
    ctypes.PyDLL(None).sleep(int(BLOCKED_S))


def fail() -> None:
    raise ValueError("no answer")


def think() -> None:
    time.sleep(10 * BLOCKED_S)


def crash() -> None:
    ctypes.string_at(0)


def use_all_memory() -> None:
    """As far as the system lets this process go, which is a little more than it has."""
    in_use = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (in_use + 64 * 2**20, resource.RLIM_INFINITY))
    blocks = []
    while True:
        blocks.append(bytearray(2**20))


def stand_in_for_an_image_callback_that_spins(policy: HarmfulSwing) -> None:
    """What stores an image holds the GIL; none of ours does that."""
    add = Ring.add

    def spin(ring: Ring, receipt: float, stamp: float | None, message: Any) -> bool:
        if type(message).__name__ == "Image":
            Ring.add = add  # type: ignore[method-assign]
            policy.begun()
            # Other threads ask for the lock after so many seconds, and get it between two lines.
            sys.setswitchinterval(10 * BLOCKED_S)
            until = time.monotonic() + BLOCKED_S
            while time.monotonic() < until:
                pass
            sys.setswitchinterval(0.005)
        return add(ring, receipt, stamp, message)

    Ring.add = spin  # type: ignore[method-assign]


def stand_in_for_a_link_that_is_not_read(policy: HarmfulSwing) -> None:
    """The thread that reads what the control process sends finds nothing, for a while."""
    receive = Link.receive
    # Of no interest on this program's terminal.
    DRIVER.propagate = False
    DRIVER.addHandler(logging.NullHandler())
    policy.begun()
    (policy.folder / FLOOD).touch()
    Link.receive = lambda link: None  # type: ignore[method-assign]
    time.sleep(BLOCKED_S)
    (policy.folder / FLOOD).unlink()
    Link.receive = receive  # type: ignore[method-assign]


def stand_in_for_a_link_whose_thread_ends(policy: HarmfulSwing) -> None:
    """As for want of memory."""

    def receive(link: Link) -> None:
        policy.begun()
        raise MemoryError

    Link.receive = receive  # type: ignore[method-assign]


def compete_for_the_processors(policy: HarmfulSwing) -> None:
    """Processes of this one's session compute, which leave it a small part of the processors.

    What is stored from then on is the last moment at which this process ran Python.
    """
    file = os.open(policy.folder / PROVOKED, os.O_CREAT | os.O_WRONLY)
    until = time.monotonic() + COMPETING_S
    busy = f"import time\nwhile time.monotonic() < {until}: pass"
    for _ in range(COMPETITORS):
        subprocess.Popen([sys.executable, "-c", busy], env={})

    def note() -> None:
        while True:
            # In place: the file is whole at any moment.
            os.pwrite(file, f"{time.monotonic():020.6f}".encode(), 0)
            time.sleep(0.001)

    threading.Thread(target=note, daemon=True).start()


def in_get_frame(name: str) -> Callable[[HarmfulSwing], None]:
    """``WholeArm``, in the control process, does it."""
    return lambda policy: (policy.folder / name).touch()


def block_a_hook(policy: HarmfulSwing) -> None:
    policy.blocks = True


HARMS: Mapping[str, Callable[[HarmfulSwing], None]] = {
    "keep the interpreter": in_policy(keep_interpreter),
    "fail": in_policy(fail),
    "think": in_policy(think),
    "crash": in_policy(crash),
    "use all memory": in_policy(use_all_memory),
    "image callback spins": stand_in_for_an_image_callback_that_spins,
    "link is not read": stand_in_for_a_link_that_is_not_read,
    "hook blocks": block_a_hook,
    "compete for the processors": compete_for_the_processors,
    "link's thread ends": stand_in_for_a_link_whose_thread_ends,
    "get_frame blocks": in_get_frame(BLOCK),
    "get_frame keeps the interpreter": in_get_frame(KEEP),
}
