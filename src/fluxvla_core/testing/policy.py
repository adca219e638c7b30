"""Conformance tests for policies, which a plugin inherits.

    from fluxvla_core.testing import PolicyConformance

    class TestMyPolicy(PolicyConformance):
        entry_point = "MyPolicy"

pytest collects the inherited tests. Control loop and evaluation rely on what they check: chunks of
one shape, in physical units, that follow from the seed and the observations alone.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import pytest

from fluxvla_core.contracts.check import ON_A_ROBOT, check_policy
from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.environment import Environment
from fluxvla_core.contracts.frame import Observation
from fluxvla_core.contracts.policy import Actor, Continuation, with_history
from fluxvla_core.errors import FluxError
from fluxvla_core.spec import EmbodimentSpec
from fluxvla_core.testing._conformance import Conformance, calling, capability, equal

Chunk = npt.NDArray[np.float64]
SEED = 11
_QUESTIONS = 3
# Targets further beyond a limit than the whole range are of another unit, not of a bold policy.
_BEYOND = 1.0


class PolicyConformance(Conformance):
    """Inherit, set ``entry_point`` and ``arguments``, and run pytest."""

    registry = "policies"
    drives_robots: ClassVar[bool] = True
    """Whether it has the attributes that robots need; False for a policy of simulations alone."""
    instruction: ClassVar[str] = "pick up the red cup"
    """The instruction of the observations."""
    spec: ClassVar[EmbodimentSpec | None] = None
    """The embodiment that it is asked for; its own by default."""

    @pytest.fixture
    def policy(self) -> Actor:
        """A new policy."""
        return self.policy_of(self.make())

    def policy_of(self, made: Any) -> Actor:
        """``made`` with the defaults of what it lacks, in the environment if there is one."""
        policy = Actor.adapt(made)
        environment = self.environment()
        if environment is not None:
            policy.enter(environment)
        return policy

    def environment(self) -> Environment | None:
        """An environment in an episode, for a policy that looks into it (``enter``); None here."""
        return None

    def embodiment(self, policy: Actor) -> EmbodimentSpec:
        """The embodiment that observations are made for."""
        environment = self.environment()
        spec = self.spec or policy.embodiment
        if spec is None and environment is not None:
            spec = environment.spec.embodiment
        assert spec is not None, (
            f"{self.entry_point}.embodiment is None: set spec in this kit's subclass to the "
            "embodiment that it is asked for, because observations follow from it"
        )
        return spec

    def observation(self, policy: Actor, number: int = 0) -> Observation:
        """Observation ``number``: a state near the middle of the limits, and images of noise.

        With the observations before it as its history, for a policy that needs one.
        """
        steps = policy.n_obs_steps
        before = [self._observation(policy, i) for i in range(max(0, number + 1 - steps), number)]
        return with_history(self._observation(policy, number), steps, before)

    def _observation(self, policy: Actor, number: int) -> Observation:
        spec = self.embodiment(policy)
        rng = np.random.default_rng(number)
        joints = {joint.name: joint for joint in spec.joints}
        known = [joints[name] for name in spec.state_names if name in joints]
        state = np.zeros(spec.state_dim, np.float32)
        if len(known) == spec.state_dim:
            share = 0.5 + 0.05 * rng.uniform(-1.0, 1.0, spec.state_dim)
            low = np.array([joint.lower for joint in known])
            high = np.array([joint.upper for joint in known])
            state = (low + share * (high - low)).astype(np.float32)
        images = {
            camera.name: rng.integers(0, 256, (camera.height, camera.width, 3), np.uint8)
            for camera in spec.cameras
            if camera.name in policy.cameras
        }
        return {"qpos": state, "images": images, "task_description": self.instruction}

    def episode(self, policy: Actor, seed: int = SEED) -> list[Chunk]:
        """Its answers to the first observations of an episode."""
        policy.reset(seed)
        seen = (self.observation(policy, number) for number in range(_QUESTIONS))
        return [np.array(self.asked(policy, one)) for one in seen]

    def asked(self, policy: Actor, observation: Observation) -> Any:
        """The result of ``predict_action``."""
        hint = (
            "the state follows from spec, its own embodiment by default, and the images are those "
            "of its cameras; set these, or override observation(policy, number) in this kit's "
            "subclass (fluxvla plugins check: --kit FILE with such a subclass)"
        )
        with calling(f"{self.entry_point}.predict_action()", dict(observation), hint):
            return policy.predict_action(observation)

    def test_it_says_what_driving_a_robot_takes(self, policy: Actor) -> None:
        names = ", ".join(ON_A_ROBOT)
        capability(self.drives_robots, f"a policy that is to drive a robot has {names}")
        problem = ""
        try:
            check_policy(policy)
        except FluxError as error:
            problem = str(error)
        assert not problem, f"{problem} (a policy of simulations alone sets drives_robots = False)"

    def test_a_chunk_has_its_shape(self, policy: Actor) -> None:
        policy.reset(SEED)
        dim = self.embodiment(policy).dim
        for number in range(_QUESTIONS):
            chunk = self.asked(policy, self.observation(policy, number))
            assert isinstance(chunk, np.ndarray), (
                f"predict_action() gave a {type(chunk).__name__}, expected a numpy array of shape "
                f"(T, {dim}): chunks are joined and limited as arrays"
            )
            assert chunk.ndim == 2, (
                f"predict_action() gave the shape {chunk.shape}, expected (T, {dim}): one row for "
                "each action of the chunk"
            )
            assert chunk.shape[1] == dim, (
                f"predict_action() gave rows of {chunk.shape[1]}, expected {dim}: one number for "
                f"each of {', '.join(self.embodiment(policy).joint_names)}"
            )
            assert chunk.dtype == np.float64, (
                f"predict_action() gave {chunk.dtype}, expected float64: commands are compared "
                "with limits at that precision"
            )
            length = policy.horizon
            assert length is None or len(chunk) == length, (
                f"predict_action() gave {len(chunk)} actions, and horizon is {length}: the runner "
                "plans the next question by it"
            )
            assert np.isfinite(chunk).all(), (
                "predict_action() gave a number that is not finite, expected finite ones: the "
                "safety stops the robot at the first"
            )

    def test_actions_are_in_the_unit_of_the_joints(self, policy: Actor) -> None:
        spec = self.embodiment(policy)
        capability(spec.action_mode == "absolute", "only absolute targets can be compared")
        chunks = np.concatenate(self.episode(policy))
        for column, joint in enumerate(spec.joints):
            span = _BEYOND * (joint.upper - joint.lower)
            low, high = chunks[:, column].min(), chunks[:, column].max()
            assert joint.lower - span <= low <= high <= joint.upper + span, (
                f"predict_action() sends {joint.name} from {low:.4g} to {high:.4g}, expected "
                f"targets about its limits of {joint.lower:g} to {joint.upper:g} {joint.unit}: are "
                "they normalised, or of another unit (degrees for radians)?"
            )

    def test_an_episode_follows_from_its_seed(self, policy: Actor) -> None:
        first = self.episode(policy)
        self.episode(policy, SEED + 1)
        for chunk, again in zip(first, self.episode(policy), strict=True):
            assert np.array_equal(chunk, again), (
                f"after reset({SEED}) the same observations gave other actions than in an earlier "
                f"episode, by up to {np.abs(chunk - again).max():.3g}, expected the same: what is "
                "kept from one episode to the next makes results unrepeatable"
            )

    def test_another_object_gives_the_same_episode(self, policy: Actor) -> None:
        first = self.episode(policy)
        other = self.policy_of(self.make())
        np.random.seed(1)
        for chunk, again in zip(first, self.episode(other), strict=True):
            assert np.array_equal(chunk, again), (
                f"a new {self.entry_point} gave other actions after reset({SEED}), by up to "
                f"{np.abs(chunk - again).max():.3g}, expected the same: an evaluation's processes "
                "each have one of their own"
            )

    def test_the_observation_belongs_to_the_caller(self, policy: Actor) -> None:
        policy.reset(SEED)
        observation, untouched = self.observation(policy), self.observation(policy)
        self.asked(policy, observation)
        assert equal(dict(observation), dict(untouched)), (
            "predict_action() changed the observation that it was given, expected it untouched: "
            "the same arrays go into recordings and to hooks"
        )

    def test_chunks_are_fresh_arrays(self, policy: Actor) -> None:
        policy.reset(SEED)
        first = self.asked(policy, self.observation(policy))
        kept = first.copy()
        second = self.asked(policy, self.observation(policy, 1))
        assert np.array_equal(first, kept), (
            "a second predict_action() changed the chunk that the first gave, expected fresh "
            "arrays: the first chunk is still being played"
        )
        assert not np.shares_memory(first, second), (
            "two answers of predict_action() share memory, expected fresh arrays: the runner keeps "
            "both while it joins them"
        )

    def test_it_continues_a_chunk(self, policy: Actor) -> None:
        own = implements(policy, Actor, "continue_action") and policy.continues
        capability(own, "it would define continue_action(observation, rest), for chunk_joining rtc")
        (first, *_) = self.episode(policy)
        length = len(first)
        weights = np.linspace(1.0, 0.0, length)
        rest = Continuation(first.copy(), weights, frozen=min(2, length))
        chunk = policy.continue_action(self.observation(policy, 1), rest)
        assert np.shape(chunk) == first.shape, (
            f"continue_action() gave the shape {np.shape(chunk)}, expected {first.shape} as "
            "predict_action() gives: it takes the place of that chunk"
        )
        assert np.isfinite(chunk).all(), (
            "continue_action() gave a number that is not finite, expected finite ones: the safety "
            "stops the robot at the first"
        )
        assert np.array_equal(rest.actions, first), (
            "continue_action() changed rest.actions, expected them untouched: they are being played"
        )
