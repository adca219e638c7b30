"""What every test of the repository runs with, also when pytest is called without nox."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Generator, Iterator, Sequence

# Before torch and MuJoCo are imported: sums must not depend on a number of threads where results
# of several processes are compared bit for bit, and there is no display to render to. A machine
# with one GPU could not run two ranks on it, and what is compared to the bit is compared on CPUs.
for name, value in (
    ("OMP_NUM_THREADS", "1"),
    ("MUJOCO_GL", "egl"),
    ("LP_NUM_THREADS", "1"),
    ("CUDA_VISIBLE_DEVICES", ""),
):
    os.environ.setdefault(name, value)

# Started in the background of a script, a process ignores Ctrl-C, under nohup the loss of its
# terminal, and so does all that it starts; a test of either would then wait for nothing.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_DFL)

from pathlib import Path  # noqa: E402

import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

from tools import stages  # noqa: E402
from tools.stalls import STALL_S, StallWatch  # noqa: E402

# How long an example takes says something about the machine, not about the project.
settings.register_profile("fluxvla", deadline=None)
settings.load_profile("fluxvla")


# Marks of tests with deadlines, and how often one is run again because of the machine.
DEADLINES, RERUNS = ("network", "realtime"), 2


class Stalled:
    """Whether the machine stood still during the present attempt of a test."""

    def __init__(self) -> None:
        self.watch: StallWatch | None = None
        self.began = 0.0

    def begin(self) -> None:
        if self.watch is None:
            self.watch = StallWatch()
        self.began = time.monotonic()

    def __call__(self) -> bool:
        return self.watch is not None and self.watch.longest_s(self.began) > STALL_S


STALLED = Stalled()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection_modifyitems(
    config: pytest.Config, items: list[pytest.Item]
) -> Generator[None]:
    """What opens a ROS network waits for other processes, which a busy machine keeps waiting.

    Tests with deadlines are run again if they fail while the machine stands still.
    """
    for item in items:
        if "ros_domain" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.network)
    yield  # others leave tests out here, by their marks
    if config.pluginmanager.hasplugin("rerunfailures") and not config.option.usepdb:
        for item in items:
            if any(item.get_closest_marker(name) for name in DEADLINES):
                item.add_marker(pytest.mark.flaky(reruns=RERUNS, condition=STALLED))
    if "PYTEST_XDIST_WORKER" in os.environ:
        begin_with_what_takes_long(items)


def begin_with_what_takes_long(items: list[pytest.Item]) -> None:
    """Sort the tests, so that several processes end at about the same time.

    What is marked 'early' comes first, then files as xdist sorts them: those of many tests first.
    """
    units = [unit_of(item) for item in items]
    count = Counter(units)
    first = {
        unit for unit, item in zip(units, items, strict=True) if item.get_closest_marker("early")
    }
    order = {unit: (unit not in first, -count[unit], place) for place, unit in enumerate(count)}
    items.sort(key=lambda item: order[unit_of(item)])


def unit_of(item: pytest.Item) -> str:
    """What one process runs as a whole: a group of ``xdist_group``, else the test's file."""
    group = item.get_closest_marker("xdist_group")
    return str(group.args[0]) if group is not None and group.args else str(item.path)


def pytest_deselected(items: Sequence[pytest.Item]) -> None:
    """Where the tests of the other stages are: these need not look through all files again."""
    place = os.environ.get(stages.FILE)
    if place and os.environ.get("PYTEST_XDIST_WORKER") == "gw0":  # each process sees them all
        marks = [(item.path, {mark.name for mark in item.iter_markers()}) for item in items]
        stages.note(Path(place), [(file, names) for file, names in marks if "slow" not in names])


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("flaky"):
        STALLED.begin()


def pytest_unconfigure() -> None:
    if STALLED.watch is not None:
        STALLED.watch.close()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Show which tests the machine failed.

    Note the skipped tests: a session lists those of all its stages at its end.
    """
    for report in terminalreporter.stats.get("rerun", []):
        terminalreporter.write_line(f"run again, the machine stood still: {report.nodeid}")
    place = os.environ.get(stages.SKIPPED)
    if place and "PYTEST_XDIST_WORKER" not in os.environ:  # its controller counts what it skipped
        reports = terminalreporter.stats.get("skipped", [])
        stages.note_skipped(Path(place), [(r.nodeid, reason_of(r)) for r in reports])


def reason_of(report: pytest.TestReport) -> str:
    place = report.longrepr
    text = str(place[2] if isinstance(place, tuple) else place)
    return text.removeprefix("Skipped: ").partition("\n")[0]


@pytest.fixture(autouse=True)
def _forget_plugin_files() -> Iterator[None]:
    """Unload the plugin files of a test (``--plugin FILE``)."""
    yield
    files = sys.modules.get("fluxvla_core.plugins.registry")
    if files is not None:
        files.forget_plugin_files()
