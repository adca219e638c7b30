"""Fixtures for tests with real ROS 2: a domain of one's own, and drivers in processes.

    from fluxvla_core.testing.ros2 import drivers, ros_domain  # noqa: F401

Tests that use them are skipped where ``rclpy`` cannot be imported, with the way to get it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from importlib import resources
from typing import Any

import pytest

from fluxvla_core.errors import LoadFailed
from fluxvla_core.ros2.require import require_rclpy
from fluxvla_core.testing.ros2_driver import Driver

# Domains up to 101 keep clear of the ports that Linux hands out to others.
_DOMAINS = 100


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """A domain that only this process and its children use; nothing leaves the machine."""
    try:
        require_rclpy()
    except LoadFailed as error:
        pytest.skip(f"{error.what}; {error.next}")
    domain = 1 + os.getpid() % _DOMAINS
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    # What Humble has in its place.
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    profile = resources.files("fluxvla_core.testing") / "fastdds_quick_discovery.xml"
    monkeypatch.setenv("FASTDDS_DEFAULT_PROFILES_FILE", str(profile))
    return domain


@pytest.fixture
def drivers(ros_domain: int) -> Iterator[Callable[..., Driver]]:
    """Call it as ``Driver``; every process is ended after the test."""
    started: list[Driver] = []

    def start(*args: Any, **options: Any) -> Driver:
        started.append(Driver(*args, **options))
        return started[-1]

    yield start
    for driver in started:
        driver.close()
