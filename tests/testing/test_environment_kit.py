"""The conformance kit of environments: the walker passes, and each broken promise is found."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from fluxvla_core.plugins.files import load_plugin_files
from fluxvla_core.plugins.registry import ENVIRONMENTS
from fluxvla_core.testing import EnvironmentConformance
from tests.evaluation.conftest import WALKING


@pytest.fixture(autouse=True)
def walk():
    load_plugin_files([WALKING])
    return sys.modules["fluxvla_plugin_walking"].Walk


class TestWalk(EnvironmentConformance):
    entry_point = "Walk"


class TestLimitedWalk(EnvironmentConformance):
    entry_point = "Walk"
    arguments = {"limited": True}  # noqa: RUF012


CHECKS = {
    "drifts": "test_a_course_follows_from_task_and_seed_alone",
    "deaf": "test_another_seed_is_another_course",
    "shy": "test_looking_changes_nothing",
    "lends": "test_states_belong_to_whoever_asked",
    "blind": "test_what_is_seen_is_what_the_spec_says",
}


@pytest.mark.parametrize("fault", CHECKS)
def test_a_broken_promise_is_found(walk, fault):
    class Broken(walk):
        drift = 0

        def reset(self, seed, task):
            type(self).drift += fault == "drifts"
            super().reset(0 if fault == "deaf" else seed + self.drift, task)
            self.row = np.zeros(1)

        @property
        def state(self):
            if fault != "lends":
                return super().state
            self.row[:] = self.place
            return self.row

        def step(self, action):
            found = super().step(np.zeros(1) if fault == "deaf" else action)
            if fault == "lends":
                self.row[:] = self.place
            return found

        def observe(self, cameras):
            if fault == "shy" and cameras:
                self.place += 0.01
            seen = super().observe(cameras)
            return {**seen, "images": {}} if fault == "blind" else seen

    ENVIRONMENTS.register_module("Broken")(Broken)

    class Kit(EnvironmentConformance):
        entry_point = "Broken"

    kit, environment = Kit(), Broken()
    try:
        with pytest.raises((AssertionError, KeyError)):
            getattr(kit, CHECKS[fault])(environment)
    finally:
        ENVIRONMENTS.unregister("Broken")
