"""Fixtures for tests with real ROS 2: a domain of one's own, and drivers in processes.

    from fluxvla_core.testing.ros2 import drivers, lasting_drivers, ros_domain  # noqa: F401

Tests that use them are skipped where ``rclpy`` cannot be imported, with the way to get it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from importlib import resources

import pytest

from fluxvla_core.errors import LoadFailed
from fluxvla_core.ros2 import require_rclpy
from fluxvla_core.testing.ros2_driver import Driver
from fluxvla_core.testing.ros_domains import claimed_domain

__all__ = ["Driver", "drivers", "lasting_drivers", "other_domain", "ros_domain"]


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
