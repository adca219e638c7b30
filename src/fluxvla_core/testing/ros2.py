"""Fixtures for tests with real ROS 2: a domain of one's own, and drivers in processes.

    from fluxvla_core.testing.ros2 import drivers, lasting_drivers, ros_domain  # noqa: F401

Tests that use them are skipped where ``rclpy`` cannot be imported, with the way to get it.
"""

from __future__ import annotations

import errno
import fcntl
import os
import socket
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from importlib import resources
from pathlib import Path

import pytest

from fluxvla_core.errors import LoadFailed
from fluxvla_core.ros2 import require_rclpy
from fluxvla_core.testing.ros2_driver import Driver

__all__ = ["Driver", "drivers", "lasting_drivers", "other_domain", "ros_domain"]

# Domains up to 101 keep clear of the ports that Linux hands out to others.
DOMAINS = range(1, 101)
# DDSI-RTPS 2.5, 9.6.2: a domain's first participant is discovered at port 7400 + 250 d + 10.
_PORT_BASE, _PORT_GAIN, _PORT_OFFSET = 7400, 250, 10


@pytest.fixture(scope="module")
def ros_domain() -> Iterator[int]:
    """A domain that only this process and its children use; nothing leaves the machine."""
    try:
        require_rclpy()
    except LoadFailed as error:
        pytest.skip(f"{error.what}; {error.next}")
    profile = resources.files("fluxvla_core.testing") / "fastdds_quick_discovery.xml"
    with claimed_domain() as domain, pytest.MonkeyPatch.context() as environment:
        environment.setenv("ROS_DOMAIN_ID", str(domain))
        environment.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        if os.environ.get("ROS_DISTRO") == "humble":
            # What Humble has in its place; later ones let it override transports in profiles.
            environment.setenv("ROS_LOCALHOST_ONLY", "1")
        environment.setenv("FASTDDS_DEFAULT_PROFILES_FILE", str(profile))
        yield domain


@pytest.fixture
def other_domain(ros_domain: int) -> Iterator[int]:
    """One more domain of one's own, on which nobody is."""
    with claimed_domain() as domain:
        yield domain


@pytest.fixture
def drivers(ros_domain: int) -> Iterator[Callable[..., Driver]]:
    """Call it as ``Driver``; every process is ended after the test."""
    with ExitStack() as stack:
        yield lambda *args, **options: stack.enter_context(Driver(*args, **options))


@pytest.fixture(scope="module")
def lasting_drivers(ros_domain: int) -> Iterator[Callable[..., Driver]]:
    """Like ``drivers``, for processes that serve all tests of a module."""
    with ExitStack() as stack:
        yield lambda *args, **options: stack.enter_context(Driver(*args, **options))


@contextmanager
def claimed_domain(folder: Path | None = None) -> Iterator[int]:
    """A domain that nobody else on this machine has, for as long as the context lasts.

    Test processes keep out of each other's way by a lock on a file per domain, which ends with the
    process however that ends; participants without locks are recognised by their port.

    Args:
        folder: where the files are; the same for all who must not meet.

    Raises:
        RuntimeError: every domain is taken.
    """
    folder = folder or Path(tempfile.gettempdir()) / f"fluxvla-ros-domains-{os.getuid()}"
    folder.mkdir(parents=True, exist_ok=True)
    # Begin anywhere, so that a domain comes back late: who used it last may still say goodbye.
    start = os.getpid() % len(DOMAINS)
    for domain in (*DOMAINS[start:], *DOMAINS[:start]):
        file = os.open(folder / str(domain), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            if _lock(file) and _silent(domain):
                yield domain
                return
        finally:
            os.close(file)
    raise RuntimeError(f"all {len(DOMAINS)} ROS domains are taken; their locks are in {folder}")


def _lock(file: int) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _silent(domain: int) -> bool:
    """Whether nobody listens where the domain's first participant would."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", _PORT_BASE + _PORT_GAIN * domain + _PORT_OFFSET))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            return False
    return True
