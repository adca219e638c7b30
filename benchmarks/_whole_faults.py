"""What goes wrong with an operator that runs as a whole in the control process, provoked for real.

The rows of docs/safety.md that begin with "whole operator". The program is that of
``_process_faults``, its arm one of the old shape in the control process, which stores when it
received which command. No middleware takes part.
"""

from __future__ import annotations

import signal
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from benchmarks import _process_faults
from benchmarks._process_faults import CONTROL, KILLED, LOCKED, MAIN, order, pause, send, to_control
from benchmarks._process_program import RECEIVED
from benchmarks._robot_faults import NAMES, Fault, Result

PREFIX = "whole operator: "


@dataclass
class WholeStage:
    """Who takes part: an arm in the program itself.

    Args:
        folder: of the program.
        arm: the operator's class.
        safety: of its runner.
    """

    folder: Path
    arm: str = "WholeArm"
    safety: Mapping[str, float] = field(default_factory=dict)

    def commands(self) -> Sequence[tuple[float, list[float]]]:
        """When the arm received each command, and the positions in it."""
        place = self.folder / RECEIVED
        if not place.exists():
            return []
        numbers = np.fromfile(place)
        width = 1 + len(NAMES)
        rows = numbers[: len(numbers) // width * width].reshape(-1, width)
        return [(row[0], row[1:]) for row in rows.tolist()]


def play(folder: Path, fault: Fault) -> Result:
    """Run, provoke, and see what came of it; as ``_process_faults.play``."""
    return _process_faults.play(WholeStage(folder), fault)


_FAULTS = [
    Fault(
        "policy holds the GIL for 5 s",
        order("keep the interpreter"),
        LOCKED,
        rule=MAIN,
    ),
    Fault(
        "policy uses all memory",
        order("use all memory"),
        "MemoryError",
        rule="policy",
    ),
    Fault("main process paused (SIGSTOP)", pause, LOCKED, rule=MAIN),
    Fault(
        "main process killed (SIGKILL, or the kernel is out of memory)",
        send(signal.SIGKILL),
        KILLED,
        exit_code=-signal.SIGKILL,
    ),
    Fault(
        "get_frame() blocks for 5 s",
        order("get_frame blocks"),
        r"WholeArm\.get_frame\(\) has not returned for \d+\.\d+ s",
        rule="freshness",
    ),
    Fault(
        "get_frame() holds the GIL for 5 s",
        order("get_frame keeps the interpreter"),
        r"the control process did not run for \d+\.\d s and was killed",
        rule=CONTROL,
        braked=False,
    ),
    Fault(
        "control process killed (SIGKILL)",
        to_control(signal.SIGKILL),
        "the control process was killed by SIGKILL: nothing commands the robot any more",
        rule=CONTROL,
        braked=False,
    ),
    Fault("SIGTERM", send(signal.SIGTERM), "stopped by SIGTERM"),
]
WHOLE_FAULTS = tuple(replace(fault, name=PREFIX + fault.name) for fault in _FAULTS)
