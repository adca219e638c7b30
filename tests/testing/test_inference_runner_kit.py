"""The kit of inference runners: a right one passes, and each wrong one fails its own check."""

from __future__ import annotations

import pytest

from .specimens import Fault, Outcomes, check_fault, check_good, outcomes

GOOD = """
import numpy as np
from fluxvla_core import RUNNERS, BaseInferenceRunner
from fluxvla_core.testing import InferenceRunnerConformance, StandInRobot

@RUNNERS.register_module()
class Specimen(BaseInferenceRunner):
    api = "1.0"
    def __init__(self, gain: float = 1.0, **kwargs):
        super().__init__(**kwargs)
        self.gain = gain
    def get_ros_observation(self):
        frame = self.ros_operator.get_frame()
        return (*(frame.images[name] for name in self._cameras), frame.state)
    def update_observation_window(self):
        *images, state = self.get_ros_observation()
        return {"qpos": state.astype(np.float32), "images": dict(zip(self._cameras, images))}
    def _execute_actions(self, actions, rate):
        for action in actions:
            self.ros_operator.move(action)
            rate.sleep()

class Robot(StandInRobot):
    def move(self, action):
        self.receive(action)

class TestSpecimen(InferenceRunnerConformance):
    entry_point = "Specimen"
    def robot(self):
        return Robot(self.spec)
"""
MOVE = "self.ros_operator.move(action)"
GAIN = "        self.gain = gain\n"
RUN = "    def run(self):\n        "
HAPPENS = "whatever_happens_the_robot_is_stopped"
FAULTS = {
    "no version": Fault("is_complete", 'api = "1.0"', "api = None", "the version of the contract"),
    "open": Fault(
        "constructor_names_every_parameter",
        "        super().__init__(**kwargs)\n",
        '        known = {k: v for k, v in kwargs.items() if k != "colour"}\n'
        "        super().__init__(**known)\n",
        "expected every parameter by name",
    ),
    "connects at once": Fault(
        "building_it_moves_nothing", GAIN, GAIN + "        self.ros_operator.connect()\n",
        "the constructor and run_setup() did connect to the robot",
    ),
    "own words": Fault(
        "the_policy_is_asked_with_what_the_robot_sees", GAIN,
        GAIN + '        self.task_descriptions = {"1": "lift the cube"}\n',
        "was asked to 'lift the cube', expected 'wave at the camera'",
    ),
    "other columns": Fault(
        "the_policy_is_asked_with_what_the_robot_sees", 'state.astype(np.float32)',
        'state[[1, 0, 2]].astype(np.float32)', "in the order of its joints",
        ("commands_keep_the_limits",),
    ),
    "other cameras": Fault(
        "the_policy_is_asked_with_what_the_robot_sees", "zip(self._cameras, images)",
        "zip(self._cameras, [image[:, ::-1].copy() // 2 for image in images])",
        "expected what the robot's front sees",
    ),
    "no image": Fault(
        "the_policy_is_asked_with_what_the_robot_sees", GAIN,
        GAIN + "    def run_setup(self):\n        super().run_setup()\n"
        "        self._cameras = self._cameras[:1]\n", "has no image of wrist",
    ),
    "half way": Fault(
        "commands_are_the_policys", MOVE,
        "self.ros_operator.move(0.9 * action + 0.1 * self.ros_operator.start)",
        "another unit, or actions that are left out?",
    ),
    "nothing is sent": Fault(
        "commands_are_the_policys", MOVE, "pass", "was sent no command",
        ("commands_keep_the_limits", "the_robot_is_stopped_and_given_back", HAPPENS),
    ),
    "every other command": Fault(
        "commands_keep_the_limits", "for action in actions:",
        "for action in actions[len(actions) > 1 :: 2]:",
        "Are commands left out",
    ),
    "beyond": Fault(
        "commands_keep_the_limits", MOVE,
        "self.ros_operator.move(action + 0.004)", "the policy may want more, the robot must not",
    ),
    "no stop": Fault(
        "the_robot_is_stopped_and_given_back", GAIN,
        GAIN + "        self.ros_operator.stop = lambda: None\n", "was not stopped", (HAPPENS,),
    ),
    "no close": Fault(
        "the_robot_is_stopped_and_given_back", GAIN,
        GAIN + "        self.ros_operator.close = lambda: None\n", "nobody else can connect to it",
        (HAPPENS,),
    ),
    "swallows errors": Fault(
        HAPPENS, GAIN, GAIN + RUN + "try:\n            return super().run()\n"
        "        except Exception:\n            return {}\n",
        "the policy raised an error, and run() returned as if it had been done",
    ),
    "swallows Ctrl-C": Fault(
        HAPPENS, GAIN, GAIN + RUN + "try:\n            return super().run()\n"
        '        except KeyboardInterrupt:\n            raise RuntimeError("ended")\n',
        "expected KeyboardInterrupt",
    ),
    "any task": Fault(
        "an_unknown_task_is_refused_before_anything_moves", GAIN,
        GAIN + "        self.free_tasks = True\n", "expected an error of fluxvla_core.errors",
    ),
    "an object": Fault(
        "what_run_returns_is_json", GAIN,
        GAIN + RUN + "super().run()\n        return {'runner': self}\n", "expected JSON values",
    ),
    "no seed": Fault(
        "an_episode_follows_from_its_seed", GAIN, GAIN + "        self.seed = 0\n",
        "all episodes would have the same noise",
    ),
    "its own noise": Fault(
        "an_episode_follows_from_its_seed", MOVE,
        "self.ros_operator.move(action - 1e-9 * np.random.rand(3))",
        "sent other commands, expected the same",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Outcomes:
    return outcomes(tmp_path_factory.mktemp("runners"), GOOD, FAULTS)


def test_a_right_runner_passes_every_check(found: Outcomes) -> None:
    check_good(found, checks=14)


@pytest.mark.parametrize("name", FAULTS)
def test_a_wrong_runner_fails_its_own_check(found: Outcomes, name: str) -> None:
    check_fault(found, name, FAULTS[name])
