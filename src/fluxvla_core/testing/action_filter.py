"""Conformance tests for action filters, which a plugin inherits.

    from fluxvla_core.testing import ActionFilterConformance

    class TestMyFilter(ActionFilterConformance):
        entry_point = "MyFilter"

pytest collects the inherited tests. A filter runs between policy and limits, at the rate of the
robot's commands.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import pytest

from fluxvla_core.contracts.robot import ActionFilter
from fluxvla_core.errors import ConfigError
from fluxvla_core.spec import EmbodimentSpec, Joint
from fluxvla_core.testing._conformance import Conformance

Array = npt.NDArray[np.float64]
_CALLS = 50

ARM = EmbodimentSpec(
    "arm",
    (
        *(Joint(f"joint_{n}", "rad", -2.0, 2.0, 2.0, 8.0) for n in range(1, 7)),
        Joint("gripper", "normalized", 0.0, 1.0, 2.0, 20.0, "gripper", open=1.0, closed=0.0),
    ),
    (),
    rate_hz=50.0,
)
"""Six joints and a gripper: what filters are tried with unless a kit says otherwise."""
OTHER = EmbodimentSpec("a cart", (Joint("rail", "m", -1.0, 1.0, 1.0, 4.0, "prismatic"),), (), 50.0)
"""A robot that has nothing in common with it."""


class ActionFilterConformance(Conformance):
    """Inherit, set ``entry_point`` and ``arguments``, and run pytest."""

    registry = "action_filters"
    spec: ClassVar[EmbodimentSpec] = ARM
    """The robot that it is bound to."""

    @pytest.fixture
    def filter(self) -> ActionFilter:
        """A new filter, bound, at the beginning of an episode."""
        return self.begun()

    def begun(self) -> ActionFilter:
        """A new filter, bound, at the beginning of an episode in the middle of all limits."""
        made = ActionFilter.adapt(self.make())
        made.bind(self.spec)
        made.reset(self.middle())
        return made

    def middle(self) -> Array:
        """``(dim,)`` the middle of all limits."""
        return np.array([(j.lower + j.upper) / 2 for j in self.spec.joints])

    def targets(self, count: int = 6) -> Array:
        """``(count, dim)`` targets within the limits, as a policy gives them."""
        rng = np.random.default_rng(3)
        low = np.array([joint.lower for joint in self.spec.joints])
        high = np.array([joint.upper for joint in self.spec.joints])
        share = 0.5 + 0.2 * rng.uniform(-1.0, 1.0, (count, len(low)))
        found: Array = low + share * (high - low)
        return found

    def course(self, filter: ActionFilter) -> Array:
        """The filtered ``targets``, from the middle of all limits."""
        filter.reset(self.middle())
        return np.stack([np.array(filter(target.copy()), float) for target in self.targets()])

    def test_it_gives_a_target(self, filter: ActionFilter) -> None:
        for target in self.targets():
            found = filter(target)
            shape = np.shape(found)
            assert shape == (self.spec.dim,), (
                f"called with {self.spec.dim} numbers it gave the shape {shape}, expected "
                f"({self.spec.dim},): one for each joint"
            )
            assert np.isfinite(found).all(), (
                f"called with finite numbers it gave {np.asarray(found).tolist()}, expected finite "
                "ones: the safety stops the robot at the first that is not"
            )

    def test_the_action_belongs_to_the_caller(self, filter: ActionFilter) -> None:
        for target in self.targets():
            given = target.copy()
            filter(given)
            assert np.array_equal(given, target), (
                "it changed the action that it was given, expected it untouched: the chunk that it "
                "is a row of is recorded, and joined with the next"
            )

    def test_what_it_gave_is_not_used_again(self, filter: ActionFilter) -> None:
        first = self.course(filter)
        filter.reset(self.middle())
        for target, expected in zip(self.targets(), first, strict=True):
            found = filter(target.copy())
            assert np.allclose(found, expected), (
                "a change of what it gave earlier changed a later answer, expected a fresh array "
                "each time: the limits write into it"
            )
            found[:] = 0.0

    def test_an_episode_does_not_depend_on_earlier_ones(self, filter: ActionFilter) -> None:
        first = self.course(filter)
        gap = float(np.abs(self.course(filter) - first).max())
        assert gap == 0.0, (
            f"after reset(pose) the same targets became others than in the episode before, by up "
            f"to {gap:.3g}, expected the same: what it keeps begins anew at reset(pose)"
        )

    def test_another_object_does_the_same(self, filter: ActionFilter) -> None:
        first = self.course(filter)
        gap = float(np.abs(self.course(self.begun()) - first).max())
        assert gap == 0.0, (
            f"a second {self.entry_point} made other targets, by up to {gap:.3g}, expected the "
            "same: the process that commands the robot has one of its own"
        )

    def test_a_robot_that_does_not_fit_is_refused_in_words(self) -> None:
        made, problem = ActionFilter.adapt(self.make()), ""
        try:
            made.bind(OTHER)
            made.reset(np.zeros(OTHER.dim))
            made(np.zeros(OTHER.dim))
        except ConfigError:
            return
        except Exception as error:  # noqa: BLE001 - said in the assertion
            problem = f"{type(error).__name__}: {error}"
        assert not problem, (
            f"bound to a robot with the one joint 'rail' it raised {problem}; expected it to work, "
            "or a ConfigError of bind(embodiment) that says what is missing, before anything moves"
        )

    def test_it_is_quick_enough(self, filter: ActionFilter) -> None:
        target = self.targets()[0]
        middle = _median(lambda: filter(target.copy()), _CALLS)
        limit = 0.5 / self.spec.rate_hz
        assert middle < limit, (
            f"a call took {1e3 * middle:.3g} ms, expected less than {1e3 * limit:.3g}, half the "
            f"time between two commands at {self.spec.rate_hz:g} Hz: a late command is a jerk"
        )


def _median(call: Callable[[], Any], count: int) -> float:
    """The median duration of ``count`` calls, in seconds."""
    taken = []
    for _ in range(count):
        start = time.perf_counter()
        call()
        taken.append(time.perf_counter() - start)
    return float(np.median(taken))
