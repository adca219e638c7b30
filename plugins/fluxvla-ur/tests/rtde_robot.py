"""A fake controller, and operators that are connected to it by ``ur-rtde``'s own client."""

from __future__ import annotations

import time

import numpy as np
import pytest
from fluxvla_ur.rtde import URRTDEOperator

from fluxvla_core.errors import Faulted

from .fake_ur import HOME, FakeUR

# Machines that run tests stall for a second; what is silent for longer is silent.
PATIENT = {"max_age_s": 2.0, "connect_timeout_s": 10.0, "watchdog_hz": 1.0}
POSE = np.array([*HOME, 1.0])


def wait_for(condition, seconds=20.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "did not happen in time"
        time.sleep(0.01)


@pytest.fixture
def robot():
    with FakeUR() as fake:
        yield fake


@pytest.fixture
def connect():
    made = []

    def make(fake, **arguments):
        operator = URRTDEOperator(fake.ip, **{**PATIENT, **arguments})
        made.append(operator)
        operator.connect()
        return operator

    yield make
    for operator in made:
        operator.close()


def said(operator, kind=Faulted):
    """What ``send_action`` says is wrong, waiting for it."""
    until = time.monotonic() + 20
    while time.monotonic() < until:
        try:
            operator.send_action(operator._last if operator._last is not None else POSE)
        except kind as error:
            return error
        time.sleep(0.02)
    pytest.fail("send_action never refused")
