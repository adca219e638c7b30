"""A plugin file: a walker on a line, an expert, and a model; workers load it by its path."""

import os
from pathlib import Path

import numpy as np

from fluxvla_core import ENVIRONMENTS, POLICIES, VLAS, Camera, EmbodimentSpec, Joint, Step, TaskSpec
from fluxvla_core.contracts.environment import EnvironmentSpec

EYE = Camera("eye", 24, 32)


def embodiment(cameras=(EYE,), mode="delta", rate=10.0):
    joint = Joint("x", "m", -2.0, 2.0, 3.0, 60.0, "prismatic")
    return EmbodimentSpec("walker", (joint,), tuple(cameras), rate, mode, "world")


@ENVIRONMENTS.register_module()
class Walk:
    """Go right to 1, or left to -1; the ground shakes by seed.

    Args:
        limited: actions are places, not steps.
        marks: a folder in which each reset leaves a mark, and where what shall crash does: seeds
            below ``crashing`` crash at every attempt, those below ``shaky`` at the first alone.
        diverging: below this seed the place is not a number after three steps.
    """

    expert = "Walker"

    def __init__(
        self, limited=False, marks=None, crashing=0, shaky=0, diverging=0, slow=0.0, max_steps=40
    ):
        tasks = (TaskSpec("right", "go right", max_steps), TaskSpec("left", "go left", max_steps))
        mode = "absolute" if limited else "delta"
        self.spec = EnvironmentSpec(
            "a line", embodiment((EYE,), mode), tasks, limited=limited, details={"ground": "shaky"}
        )
        self.limited, self.slow = limited, slow
        self.marks, self.crashing, self.shaky, self.diverging = marks, crashing, shaky, diverging
        self.closed = 0

    def reset(self, seed, task):
        if self.marks is not None:
            before = len(list(Path(self.marks).glob(f"{task}-{seed}.*")))
            (Path(self.marks) / f"{task}-{seed}.{before}.{os.getpid()}").touch()
            if seed < self.crashing or (seed < self.shaky and before == 0):
                os._exit(9)
        self.rng, self.place = np.random.default_rng(seed), 0.0
        self.left = 3 if seed < self.diverging else None
        self.scene = self.instructed = task
        self.did = {"right": False, "left": False}

    def other_tasks(self, task):
        return [each.name for each in self.spec.tasks if each.name != task]

    def set_instruction(self, task):
        self.instructed = task

    @property
    def state(self):
        return np.array([self.place])

    def step(self, action):
        assert action.shape == (1,)
        if self.slow:
            import time

            time.sleep(self.slow)
        shake = 0.02 * self.rng.normal()
        self.place = float(action[0] if self.limited else self.place + action[0]) + shake
        if self.left is not None:
            self.left -= 1
            self.place = self.place if self.left else float("nan")
        self.did["right"] |= self.place >= 1
        self.did["left"] |= self.place <= -1
        ended = self.did[self.scene] or self.did[self.instructed]
        return Step(self.place, self.did[self.scene], ended, dict(self.did))

    def observe(self, cameras):
        shade = int(np.clip(100 + 50 * np.nan_to_num(self.place), 0, 255))
        return {
            "qpos": self.state.astype(np.float32),
            "images": {c.name: np.full((c.height, c.width, 3), shade, np.uint8) for c in cameras},
            "task_description": next(
                t.instruction for t in self.spec.tasks if t.name == self.instructed
            ),
        }

    def close(self):
        self.closed += 1


@POLICIES.register_module()
class Walker:
    """Walks ``speed`` a step to where the instruction says, in chunks of 3."""

    cameras = ()

    def __init__(self, speed=0.2, noise=0.0, rate=10.0, success=True):
        self.speed, self.noise, self.action_rate_hz, self.success = speed, noise, rate, success
        self.seeds, self.executed = [], None

    def enter(self, environment):
        self.limited, self.place = environment.limited, environment

    def reset(self, seed):
        self.seeds.append(seed)
        self.rng = np.random.default_rng(seed)

    def predict_action(self, observation):
        sign = 1 if observation["task_description"] == "go right" else -1
        steps = sign * self.speed * np.arange(1, 4)[:, None]
        chunk = observation["qpos"] + steps if self.limited else np.full((3, 1), sign * self.speed)
        if self.noise:
            self.executed = chunk[:1] + self.noise * self.rng.normal(size=(1, 1))
        return chunk


@POLICIES.register_module()
class Dazed(Walker):
    """A walker that no longer knows where to go at its second chunk: NaN for every seed, or some.

    Args:
        seeds: for which.
        raises: it raises instead.
    """

    def __init__(self, seeds=None, raises=False):
        super().__init__()
        self.dazed, self.raises = seeds, raises

    def reset(self, seed):
        super().reset(seed)
        self.calls = 0

    def predict_action(self, observation):
        self.calls += 1
        if self.calls < 2 or (self.dazed is not None and self.seeds[-1] not in self.dazed):
            return super().predict_action(observation)
        if self.raises:
            raise KeyError("compass")
        return np.full((3, 1), np.nan)


@POLICIES.register_module()
class TwoLegs(Walker):
    """Is for an environment with two joints."""

    def predict_action(self, observation):
        return np.zeros((3, 2))


def little_model():
    """The class is made when it is asked for, so that most workers do without torch."""
    import torch

    class Strides(torch.nn.Module):
        action_shape = (4, 1)

        def __init__(self, width=48):
            super().__init__()
            self.see = torch.nn.Conv2d(3, width, 3, stride=2)
            self.mix = torch.nn.Linear(width + 1, width)
            self.out = torch.nn.Linear(width, 4)

        def fsdp_units(self):
            return [self.mix]

        def predict_action(self, images, states, noise):
            seen = torch.relu(self.see(images)).mean((2, 3))
            hidden = torch.tanh(self.mix(torch.cat([seen, states], 1)))
            return 0.2 + 0.3 * self.out(hidden)[..., None] + 0.2 * noise

    return Strides


if os.environ.get("WALKING_MODEL") == "1":
    VLAS.register_module("Strides")(little_model())


@POLICIES.register_module()
class Thinker(Walker):
    """A walker that looks and thinks for a while."""

    cameras = ("eye",)

    def __init__(self, seconds=0.0):
        super().__init__()
        self.seconds = seconds

    def predict_action(self, observation):
        import time

        assert observation["images"]["eye"].shape == (24, 32, 3)
        time.sleep(self.seconds)
        return super().predict_action(observation)
