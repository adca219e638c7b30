"""Arms that note when they send: in a module that the control process imports, too."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

from fluxvla_aloha.operator import AlohaOperator
from fluxvla_ur.operator import UROperator

from fluxvla_core import OPERATORS
from fluxvla_core.ros2 import RosOperator

TIMES = "FLUXVLA_BENCH_TIMES"
"""Names the file that a ``Timed`` arm writes."""


def memory_mb(process: int | str = "self") -> dict[str, float]:
    """Memory of a process in MiB, of ``/proc/<process>/smaps_rollup`` (proc(5)).

    Returns:
        ``resident``: all that is mapped and in memory; ``proportional``: of what n processes share,
        each counts the n-th part; ``private``: what no other process has mapped.
    """
    lines = Path(f"/proc/{process}/smaps_rollup").read_text(encoding="ascii").splitlines()[1:]
    kib = {name: int(value.split()[0]) for name, value in (line.split(":") for line in lines)}
    sums = {
        "resident": kib["Rss"],
        "proportional": kib["Pss"],
        "private": kib["Private_Clean"] + kib["Private_Dirty"],
    }
    return {name: round(value / 1024, 1) for name, value in sums.items()}


class Timed(RosOperator):
    """Notes when it sends; ``close`` writes that, and what its process used, to a file."""

    def __init__(self, **arguments: Any) -> None:
        super().__init__(**arguments)
        self.sent: list[float] = []
        self._began = 0.0, 0.0

    def publish_action(self, action: Any) -> None:
        if not self.sent:
            self._began = time.monotonic(), time.process_time()
        self.sent.append(time.monotonic())
        super().publish_action(action)

    def close(self) -> None:
        if self.sent and TIMES in os.environ:
            began, computed = self._began
            share = (time.process_time() - computed) / (time.monotonic() - began)
            found = {
                "sent": self.sent,
                "core_share": round(share, 3),
                "mb": memory_mb(),
            }
            Path(os.environ[TIMES]).write_text(json.dumps(found), encoding="utf-8")
            self.sent = []
        super().close()


@OPERATORS.register_module()
class TimedAloha(Timed, AlohaOperator):
    """The arms of ``robot_loop``."""


@OPERATORS.register_module()
class TimedUR(Timed, UROperator):
    """The arm of ``ur_rate``."""
