"""The kit of policies: a right one passes, and each wrong one fails its own check in words."""

from __future__ import annotations

import pytest

from .specimens import Fault, Outcomes, check_fault, check_good, outcomes

GOOD = """
import numpy as np
from fluxvla_core import POLICIES, Camera, EmbodimentSpec, Joint
from fluxvla_core.testing import PolicyConformance

SPEC = EmbodimentSpec("arm", (Joint("a", "rad", -1, 1, 2, 8), Joint("b", "rad", -1, 1, 2, 8)),
                      (Camera("front", 4, 6),), rate_hz=50)

@POLICIES.register_module()
class Specimen:
    api = "1.0"
    embodiment, action_rate_hz, horizon = SPEC, 10.0, 3
    def __init__(self, reach: float = 0.2):
        self.reach, self.calls = reach, 0
    def reset(self, seed):
        self.rng, self.calls = np.random.default_rng(seed), 0
    def predict_action(self, observation):
        self.calls += 1
        shade = observation["images"]["front"].mean() / 255.0
        steps = self.reach * shade * self.rng.uniform(-1, 1, (3, 2))
        return observation["qpos"].astype(float) + steps
    def continue_action(self, observation, rest):
        chunk = self.predict_action(observation)
        return rest.weights[:, None] * rest.actions + (1 - rest.weights)[:, None] * chunk

class TestSpecimen(PolicyConformance):
    entry_point = "Specimen"
"""
STEPS = 'return observation["qpos"].astype(float) + steps'
FAULTS = {
    "no version": Fault("is_complete", '    api = "1.0"\n', "", "the version of the contract"),
    "open": Fault(
        "constructor_names_every_parameter",
        "reach: float = 0.2):\n        self.reach",
        "reach=0.2, **more):\n        self.reach",
        "expected every parameter by name",
    ),
    "takes more": Fault(
        "it_says_what_driving_a_robot_takes", "reach: float = 0.2):", "reach: float):",
        "missing a required argument: 'reach'; set arguments",
        ("a_chunk_has_its_shape", "actions_are_in_the_unit_of_the_joints",
         "an_episode_follows_from_its_seed", "another_object_gives_the_same_episode",
         "the_observation_belongs_to_the_caller", "chunks_are_fresh_arrays",
         "it_continues_a_chunk"),
    ),
    "no rate": Fault(
        "it_says_what_driving_a_robot_takes", "action_rate_hz, horizon = SPEC, 10.0, 3",
        "action_rate_hz, horizon = SPEC, -1.0, 3", "must be positive and finite",
    ),
    "a list": Fault(
        "a_chunk_has_its_shape", STEPS, STEPS.replace("return ", "return list(") + ")",
        "gave a list, expected a numpy array",
    ),
    "one row": Fault(
        "a_chunk_has_its_shape", STEPS, STEPS + "[:1]", "gave 1 actions, and horizon is 3",
    ),
    "float32": Fault(
        "a_chunk_has_its_shape", STEPS, f"return ({STEPS[7:]}).astype(np.float32)",
        "gave float32, expected float64",
    ),
    "another width": Fault(
        "a_chunk_has_its_shape", STEPS, 'return np.zeros((3, 2, 5)) @ observation["qpos"] + steps',
        "it was given qpos (2,) float32, images {front (4, 6, 3) uint8}, task_description",
        ("actions_are_in_the_unit_of_the_joints", "an_episode_follows_from_its_seed",
         "another_object_gives_the_same_episode", "the_observation_belongs_to_the_caller",
         "chunks_are_fresh_arrays", "it_continues_a_chunk"),
    ),
    "too wide": Fault(
        "a_chunk_has_its_shape", STEPS, f"return np.pad({STEPS[7:]}, ((0, 0), (0, 1)))",
        "gave rows of 3, expected 2",
    ),
    "not finite": Fault(
        "a_chunk_has_its_shape", STEPS, f"return ({STEPS[7:]}) / 0.0",
        "not finite", ("it_continues_a_chunk", "actions_are_in_the_unit_of_the_joints",),
    ),
    "degrees": Fault(
        "actions_are_in_the_unit_of_the_joints", STEPS, f"return np.degrees(1.0 + {STEPS[7:]})",
        "degrees for radians",
    ),
    "remembers": Fault(
        "an_episode_follows_from_its_seed",
        "self.rng, self.calls = np.random.default_rng(seed), 0",
        'self.rng = getattr(self, "rng", None) or np.random.default_rng(11)',
        "gave other actions than in an earlier episode",
    ),
    "global generator": Fault(
        "an_episode_follows_from_its_seed", "self.rng.uniform(-1, 1, (3, 2))",
        "np.random.uniform(-1, 1, (3, 2))", "expected the same",
        ("another_object_gives_the_same_episode",),
    ),
    "each its own": Fault(
        "another_object_gives_the_same_episode", "self.reach, self.calls = reach, 0",
        "self.reach, self.calls = reach + (id(self) % 97) / 1e3 + self.next(), 0\n"
        "    made = [0]\n"
        "    def next(self):\n"
        "        self.made[0] += 1\n"
        "        return 0.1 * self.made[0]",
        "an evaluation's processes each have one of their own",
    ),
    "writes": Fault(
        "the_observation_belongs_to_the_caller", "self.calls += 1\n",
        'self.calls += 1; observation["images"]["front"][:2] = 0\n',
        "changed the observation that it was given",
    ),
    "one buffer": Fault(
        "chunks_are_fresh_arrays", STEPS,
        f'self.out = getattr(self, "out", np.zeros((3, 2))); self.out[:] = {STEPS[7:]}; '
        "return self.out",
        "changed the chunk that the first gave",
    ),
    "views of one plan": Fault(
        "chunks_are_fresh_arrays", STEPS,
        "self.plan = np.zeros((90, 2)) if self.calls == 1 else self.plan; "
        "return self.plan[self.calls : self.calls + 3]",
        "share memory",
    ),
    "continues with another shape": Fault(
        "it_continues_a_chunk", "(1 - rest.weights)[:, None] * chunk",
        "((1 - rest.weights)[:, None] * chunk)[:1] if len(chunk) > 4 else chunk[:1]",
        "expected (3, 2) as predict_action() gives",
    ),
    "continues in place": Fault(
        "it_continues_a_chunk", "        return rest.weights", "        rest.actions[0] += 1\n   "
        "     return rest.weights",
        "changed rest.actions",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Outcomes:
    return outcomes(tmp_path_factory.mktemp("policies"), GOOD, FAULTS)


def test_a_right_policy_passes_every_check(found: Outcomes) -> None:
    check_good(found, checks=10)


@pytest.mark.parametrize("name", FAULTS)
def test_a_wrong_policy_fails_its_own_check(found: Outcomes, name: str) -> None:
    check_fault(found, name, FAULTS[name])
