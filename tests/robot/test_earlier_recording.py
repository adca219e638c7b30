"""A recording of version 0.1.0 is still read to the bit, and can be replayed."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fluxvla_core.robot.recording.recorded import RecordedEpisode, open_recording

pytest.importorskip("rosbags")

ROOT = Path(__file__).parents[1] / "fixtures" / "recording-0.1.0"
EXPECTED = json.loads(ROOT.with_name(f"{ROOT.name}.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def recorded() -> RecordedEpisode:
    return open_recording(ROOT)


def digest(array: np.ndarray[Any, Any]) -> str:
    return hashlib.sha256(array.tobytes()).hexdigest()


def test_what_it_is_of(recorded: RecordedEpisode) -> None:
    assert recorded.instruction == EXPECTED["instruction"]
    assert list(recorded.embodiment.joint_names) == EXPECTED["joints"]
    for name, key in (("success", "success"), ("finished", "whole"), ("native", "native")):
        assert getattr(recorded, name) is EXPECTED[key]
    assert len(recorded.events) == EXPECTED["events"]


def test_every_number_and_pixel_is_the_same(recorded: RecordedEpisode) -> None:
    times, commands = recorded.commands()
    assert digest(times) == EXPECTED["command_times"]
    assert [len(commands), digest(commands)] == EXPECTED["commands"]
    states = recorded.states()[1]
    assert [len(states), digest(states)] == EXPECTED["states"]
    chunks = recorded.chunks()
    assert [len(chunks), digest(np.concatenate(chunks))] == EXPECTED["chunks"]
    front = recorded.images["front"]
    images = np.stack([front.read(index) for index in range(len(front))])
    assert [len(front), digest(images)] == EXPECTED["pictures"]


def test_its_summary_is_counted_anew(recorded: RecordedEpisode) -> None:
    summary = recorded.summary()
    assert summary["outcome"] == EXPECTED["outcome"]
    assert summary["steps"] == EXPECTED["steps"]
    assert summary["skipped_ticks"] == 0  # it has ``skipped_beats``


def test_it_can_be_replayed_as_robot_and_as_policy(bench: Any, recorded: RecordedEpisode) -> None:
    bench.run(
        record=str(bench.work_dir / "rec"),
        operator={"type": "ReplayOperator", "recording": str(ROOT)},
        policy={"type": "ReplayPolicy", "recording": str(ROOT)},
        prepare_pose=[0.1, 0, 0.5],
        max_publish_step=EXPECTED["steps"],
    )

    replayed = open_recording(bench.work_dir / "rec")
    times, commands = recorded.commands("run")
    np.testing.assert_array_equal(replayed.commands("run")[1], commands)
    assert len(times) == EXPECTED["steps"]
