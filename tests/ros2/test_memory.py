"""Images are given memory that others had, not fresh pages each time."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

FAULTS = """
import resource, sys
import numpy as np
from fluxvla_core.ros2.connection import keep_large_blocks

if sys.argv[1] == "kept":
    assert keep_large_blocks()

def images():
    for _ in range(100):
        kept = [np.ones((480, 640, 3), np.uint8) for _ in range(3)]

images()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
images()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries are left alone")
def test_pages_are_asked_for_once():
    fresh, kept = (
        int(subprocess.run([sys.executable, "-c", FAULTS, how], capture_output=True).stdout)
        for how in ("fresh", "kept")
    )

    assert kept < fresh / 10, (kept, fresh)
