"""Starts a camera driver on Cyclone DDS (``_cyclone_camera``) that Fast DDS can receive from."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

# Participants on this machine are asked directly, as ROS 2 does with LOCALHOST discovery.
CYCLONE = """
<CycloneDDS><Domain id="any">
  <General>
    <Interfaces><NetworkInterface name="lo"/></Interfaces><AllowMulticast>false</AllowMulticast>
  </General>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex>
    <MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
    <Peers><Peer address="127.0.0.1"/></Peers>
  </Discovery>
</Domain></CycloneDDS>
"""
# Fast DDS 3 matches a writer without type information only if it propagates none itself.
FAST_DDS = {
    "FASTDDS_DEFAULT_PROFILES_FILE": str(Path(__file__).with_name("_fastdds_without_types.xml"))
}


class CycloneCamera:
    """The driver's process, which publishes nothing before ``start``; a context manager."""

    def __init__(self, *topics: str, height: int, width: int, hz: float) -> None:
        line = [*topics, "--height", str(height), "--width", str(width), "--hz", str(hz)]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks._cyclone_camera", *line],
            cwd=Path(__file__).resolve().parents[1],
            env={**os.environ, "CYCLONEDDS_URI": CYCLONE},
            stdin=subprocess.PIPE,
        )

    def start(self) -> None:
        """Publish from now on."""
        assert self._process.stdin is not None
        self._process.stdin.write(b"\n")
        self._process.stdin.flush()

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()

    def __enter__(self) -> CycloneCamera:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
