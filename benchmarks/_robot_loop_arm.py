"""The arms of ``robot_loop``: in a module that the control process imports, too."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

from fluxvla_aloha.operator import AlohaOperator

from fluxvla_core import OPERATORS

TIMES = "FLUXVLA_BENCH_TIMES"
"""Names the file that ``TimedAloha`` writes."""


def proportional_mb() -> float:
    """Memory of this process in MiB; of what processes share, each counts its part."""
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
    (kib,) = (line.split()[1] for line in lines if line.startswith("Pss:"))
    return int(kib) / 1024


def resident_mb() -> float:
    """Resident memory of this process, in MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


@OPERATORS.register_module()
class TimedAloha(AlohaOperator):
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
                "mb": round(resident_mb(), 1),
            }
            Path(os.environ[TIMES]).write_text(json.dumps(found), encoding="utf-8")
            self.sent = []
        super().close()
