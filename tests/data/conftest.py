"""A small real dataset: three episodes, two cameras, two instructions."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fluxvla_core.data.writer import LeRobotWriter
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

HOLD, HAND = "hold the cube", "hand the cube over"


def make_spec(**changes: Any) -> EmbodimentSpec:
    joints = (
        Joint("waist", "rad", -3.0, 3.0, 2.0, 4.0),
        Joint("elbow", "rad", -2.0, 2.0, 2.0, 4.0),
        Joint("gripper", "normalized", 0.0, 1.0, 2.0, 4.0, "gripper", open=1.0, closed=0.0),
    )
    cameras = (Camera("top", 480, 640), Camera("wrist", 480, 640))
    values: dict[str, Any] = {"name": "arm", "joints": joints, "cameras": cameras, "rate_hz": 50.0}
    return EmbodimentSpec(**{**values, **changes})


@dataclass(frozen=True)
class Take:
    """What one episode was made of; images are smooth, so that lossy video stays near them."""

    key: int
    task: str
    state: np.ndarray
    action: np.ndarray
    top: np.ndarray
    wrist: np.ndarray

    def record(self, writer: LeRobotWriter) -> None:
        for i in range(len(self.state)):
            images = {"top": self.top[i], "wrist": self.wrist[i]}
            writer.add_frame(images, self.state[i], self.action[i], self.task)
        writer.save_episode(key=self.key)


def make_take(key: int, length: int, task: str = HOLD) -> Take:
    rng = np.random.default_rng(key)
    y, x = np.mgrid[0:32, 0:48]
    t = np.arange(length)[:, None, None]
    shade = (3 * x + 2 * y + 6 * t + 40 * key) % 256
    top = np.stack([shade, shade // 2, 255 - shade], -1).astype(np.uint8)
    wrist = np.broadcast_to((20 + 9 * t + key)[..., None] % 200, (length, 16, 16, 3))
    state = rng.normal(size=(length, 3)).astype(np.float32)
    action = rng.normal(size=(length, 3)).astype(np.float32)
    return Take(key, task, state, action, top, wrist.astype(np.uint8).copy())


TAKES = (make_take(0, 7), make_take(1, 12, HAND), make_take(2, 9))


def record(root: Path, takes: Any = TAKES, **options: Any) -> Path:
    spec = options.pop("embodiment", make_spec())
    with LeRobotWriter(root, 10, spec, **options) as writer:
        for take in takes:
            take.record(writer)
    return root


@pytest.fixture(scope="session")
def takes() -> tuple[Take, ...]:
    return TAKES


@pytest.fixture(scope="session")
def spec() -> Callable[..., EmbodimentSpec]:
    return make_spec


@pytest.fixture(scope="session")
def take() -> Callable[..., Take]:
    return make_take


@pytest.fixture(scope="session")
def recorder() -> Callable[..., Path]:
    """``recorder(root, takes=…, **options)`` writes a dataset."""
    return record


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset of ``takes``; nobody changes it."""
    return record(tmp_path_factory.mktemp("data") / "shared")


@pytest.fixture
def dataset(tmp_path: Path, shared: Path) -> Path:
    """A copy of it that a test may damage."""
    return shutil.copytree(shared, tmp_path / "dataset")
