"""What every test of the repository runs with, also when pytest is called without nox."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator

# Before torch and MuJoCo are imported: sums must not depend on a number of threads where results
# of several processes are compared bit for bit, and there is no display to render to.
for name, value in (("OMP_NUM_THREADS", "1"), ("MUJOCO_GL", "egl"), ("LP_NUM_THREADS", "1")):
    os.environ.setdefault(name, value)

# Started in the background of a script, a process ignores Ctrl-C, and so does all that it starts;
# a test of Ctrl-C would then wait for nothing.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)

import pytest  # noqa: E402

PREFIX = "fluxvla_plugin_"


@pytest.fixture(autouse=True)
def _forget_plugin_files() -> Iterator[None]:
    """What a test loaded with ``--plugin FILE`` is not there for the next one."""
    yield
    files = [name for name in sys.modules if name.startswith(PREFIX)]
    if not files:
        return
    from fluxvla_core.plugins.registry import BY_NAME

    for name in files:
        del sys.modules[name]
    for registry in BY_NAME.values():
        for key in list(registry):
            if getattr(registry.registered(key), "__module__", "").startswith(PREFIX):
                registry.unregister(key)
