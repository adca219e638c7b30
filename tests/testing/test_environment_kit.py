"""The conformance kit of environments: the walker passes, and each broken promise is found."""

from __future__ import annotations

import re
import sys

import numpy as np
import pytest

from fluxvla_core.evaluation import Step
from fluxvla_core.plugins.registry import ENVIRONMENTS, load_plugin_files
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


COURSE, SEEN = (
    "test_a_course_follows_from_task_and_seed_alone",
    "test_what_is_seen_is_what_the_spec_says",
)
# What is wrong -> the check that finds it, and part of what it says.
CHECKS = {
    "drifts": (COURSE, "when other episodes had been run before"),
    "deaf": ("test_another_seed_is_another_course", "the seed is ignored"),
    "random": ("test_another_seed_is_another_course", "everything random follows from the seed"),
    "shy": ("test_looking_changes_nothing", "observe() with 1 camera(s) took the state"),
    "nervous": ("test_looking_changes_nothing", "observe() with 0 camera(s) took the state"),
    "lends": ("test_states_belong_to_whoever_asked", "a later step() changed a state"),
    "blind": (SEEN, "the policy looks at it"),
    "mute": (SEEN, "'task_description'] is 'walk'"),
    "wide": (SEEN, "state has the shape (2,), expected (1,)"),
    "terse": ("test_a_step_says_what_it_did", "gave a float, expected a Step"),
    "grabs": ("test_a_step_says_what_it_did", "changed the action"),
    "forgets": ("test_a_step_says_what_it_did", "said success, and then no more"),
    "its own other": (
        "test_other_tasks_are_others_and_can_be_instructed",
        "expected others than itself",
    ),
    "unknown other": (
        "test_other_tasks_are_others_and_can_be_instructed",
        "expected names of spec.tasks",
    ),
    "does not listen": (
        "test_other_tasks_are_others_and_can_be_instructed",
        "as if no policy listened",
    ),
    "listens for ever": (
        "test_other_tasks_are_others_and_can_be_instructed",
        "an instruction is for one episode",
    ),
    "mistyped": ("test_its_expert_is_there", "expert is 'Wallker'"),
    "closes once": ("test_it_can_be_closed_any_number_of_times", "a second close() raised"),
}


def broken(walk, fault):
    """The walker with one fault."""

    class Broken(walk):
        drift = 0

        def reset(self, seed, task):
            type(self).drift += fault == "drifts"
            kept = vars(self).get("instructed")
            super().reset(0 if fault == "deaf" else seed + self.drift, task)
            if fault == "listens for ever":
                self.instructed = kept or task
            if fault == "random":
                self.place = float(np.random.default_rng().normal())
            self.row, self.steps = np.zeros(1), 0

        @property
        def state(self):
            if fault == "wide":
                return np.zeros(2)
            if fault != "lends":
                return super().state
            self.row[:] = self.place
            return self.row

        def step(self, action):
            found = super().step(action)
            if fault == "lends":
                self.row[:] = self.place
            if fault == "grabs":
                action += 0.1
            self.steps += 1
            if fault == "forgets":
                return Step(0.0, self.steps == 2, ended=False)
            return 0.5 if fault == "terse" else found

        def observe(self, cameras):
            if fault == "nervous" or (fault == "shy" and cameras):
                self.place += 0.01
            seen = super().observe(cameras)
            if fault == "mute":
                seen["task_description"] = "walk"
            return {**seen, "images": {}} if fault == "blind" else seen

        def other_tasks(self, task):
            if fault == "its own other":
                return [task]
            return ["up"] if fault == "unknown other" else super().other_tasks(task)

        def set_instruction(self, task):
            if fault != "does not listen":
                super().set_instruction(task)

        def close(self):
            if fault == "closes once" and self.closed:
                raise RuntimeError("closed already")
            super().close()

    if fault == "mistyped":
        Broken.expert = "Wallker"
    return Broken


@pytest.mark.parametrize("fault", CHECKS)
def test_a_broken_promise_is_found_in_words(walk, fault):
    made = broken(walk, fault)
    ENVIRONMENTS.register_module("Broken")(made)

    class Kit(EnvironmentConformance):
        entry_point = "Broken"

    check, words = CHECKS[fault]
    try:
        with pytest.raises(AssertionError, match=re.escape(words)):
            getattr(Kit(), check)(made())
    finally:
        ENVIRONMENTS.unregister("Broken")
