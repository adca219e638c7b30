"""Collections: the same for any number of workers, resumed after anything, refused when changed."""

from __future__ import annotations

import json

import numpy as np
import pytest

from fluxvla_core.contracts.reporter import SilentReporter
from fluxvla_core.data.writer import staging_of
from fluxvla_core.errors import DataError, RunFailed, UsageError
from fluxvla_core.evaluate.collecting import Recorded, collect_episodes
from fluxvla_core.spec.embodiment import Camera, EmbodimentSpec, Joint

pyarrow = pytest.importorskip("pyarrow.parquet")
pytest.importorskip("av")

SPEC = EmbodimentSpec(
    "toy",
    (Joint("a", "rad", -9, 9, 1, 1),),
    (Camera("eye", 32, 32),),
    10.0,
)


class Actor:
    """Episode k has k + 2 frames, told apart by their numbers; ``bad`` ones fail."""

    def __init__(self, bad=()):
        self.bad = bad

    def __call__(self):
        return self.act

    def act(self, number):
        if number in self.bad:
            raise RuntimeError(f"episode {number} slipped")
        frames = number + 2
        values = np.full((frames, 1), float(number)) + np.arange(frames)[:, None] / 100
        pictures = np.full((frames, 32, 32, 3), 20 * number, np.uint8)
        return Recorded({"eye": pictures}, values, values, f"do {number % 2}", number % 2)


def collect(out, episodes=4, workers=1, resume=False, settings=None, bad=()):
    return collect_episodes(
        out,
        10.0,
        SPEC,
        Actor(bad),
        episodes,
        settings or {"seed": 1},
        workers,
        resume,
        SilentReporter(),
    )


def table(out):
    return pyarrow.read_table(out / "data/chunk-000/file-000.parquet").to_pydict()


def test_the_dataset_is_the_same_for_any_number_of_workers(tmp_path):
    found = collect(tmp_path / "one")
    collect(tmp_path / "three", workers=3)
    assert found["frames"] == 2 + 3 + 4 + 5
    assert found["retried"] == 2
    assert table(tmp_path / "one") == table(tmp_path / "three")
    assert table(tmp_path / "one")["episode_index"] == [0] * 2 + [1] * 3 + [2] * 4 + [3] * 5


def test_an_interrupted_collection_goes_on_to_the_same_dataset(tmp_path):
    with pytest.raises(RunFailed, match="episode 2 failed: "):
        collect(tmp_path / "cut", bad=(2,))
    found = collect(tmp_path / "cut", resume=True)
    collect(tmp_path / "whole")
    assert found["frames"] == 4 + 5
    assert table(tmp_path / "cut") == table(tmp_path / "whole")


def test_it_does_not_go_on_unasked(tmp_path):
    with pytest.raises(RunFailed):
        collect(tmp_path / "cut", bad=(1,))
    with pytest.raises(UsageError, match="was interrupted, or is under way") as caught:
        collect(tmp_path / "cut")
    assert "--resume" in str(caught.value)


def test_it_does_not_go_on_with_other_settings(tmp_path):
    with pytest.raises(RunFailed):
        collect(tmp_path / "cut", bad=(1,))
    with pytest.raises(UsageError, match="had other settings: seed: 1 / 2"):
        collect(tmp_path / "cut", resume=True, settings={"seed": 2})
    note = staging_of(tmp_path / "cut") / "collection.json"
    assert json.loads(note.read_text()) == {"seed": 1}


def test_nothing_is_written_over(tmp_path):
    collect(tmp_path / "one", episodes=1)
    with pytest.raises(DataError, match="never written over"):
        collect(tmp_path / "one", episodes=1)
