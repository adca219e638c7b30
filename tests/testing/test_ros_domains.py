"""Nobody gets a domain that somebody else has."""

from __future__ import annotations

import socket
import subprocess
import sys
from contextlib import ExitStack

import pytest

from fluxvla_core.testing import ros_domains
from fluxvla_core.testing.ros2 import DOMAINS, claimed_domain

CLAIM = """
import sys
from pathlib import Path
from fluxvla_core.testing.ros2 import claimed_domain
with claimed_domain(Path(sys.argv[1])) as domain:
    print(domain, flush=True)
    sys.stdin.read()
"""


def test_every_claim_gets_another_domain(tmp_path):
    with ExitStack() as stack:
        found = [stack.enter_context(claimed_domain(tmp_path)) for _ in range(20)]

    assert len(set(found)) == 20
    assert set(found) <= set(DOMAINS)


def test_other_processes_count_until_they_end_however_they_do(tmp_path, monkeypatch):
    other = subprocess.Popen(
        [sys.executable, "-c", CLAIM, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    theirs = int(other.stdout.readline())
    monkeypatch.setattr(ros_domains, "DOMAINS", range(theirs, theirs + 1))
    with pytest.raises(RuntimeError, match="all 1 ROS domains are taken; their locks are in"):
        claimed_domain(tmp_path).__enter__()
    other.kill()
    other.communicate(timeout=10.0)

    with claimed_domain(tmp_path) as ours:
        assert ours == theirs


def test_a_domain_that_a_robot_is_on_is_passed_over(tmp_path, monkeypatch):
    with claimed_domain(tmp_path) as domain:
        port = 7400 + 250 * domain + 10
    monkeypatch.setattr(ros_domains, "DOMAINS", range(domain, domain + 1))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        robot.bind(("", port))
        with pytest.raises(RuntimeError, match="are taken"):
            claimed_domain(tmp_path).__enter__()
