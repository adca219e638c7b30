"""ROS domains for tests that run in parallel, on a machine where others use ROS too."""

from __future__ import annotations

import errno
import fcntl
import os
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Domains up to 101 keep clear of the ports that Linux hands out to others.
DOMAINS = range(1, 101)
# DDSI-RTPS 2.5, 9.6.2: a domain's first participant is discovered at port 7400 + 250 d + 10.
_PORT_BASE, _PORT_GAIN, _PORT_OFFSET = 7400, 250, 10


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
