"""The tables of docs/anatomy.md name the keys and shapes that the code gives."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from fluxvla_core import EmbodimentSpec, Joint
from fluxvla_core.config.check import _NAMED
from fluxvla_core.data import LeRobotWriter, ParquetDataset
from fluxvla_core.data.inference_dataset import _KEYS
from fluxvla_core.operators import Camera

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "anatomy.md").read_text(encoding="utf-8")
S, T, FRAMES = 2, 4, 12
SIZE = (32, 48)


def section(title: str) -> str:
    return re.split(r"\n#+ ", PAGE.partition(f"# {title}\n")[2], maxsplit=1)[0]


def rows(title: str) -> dict[str, str]:
    """First name of each row of the table of a section -> its second cell."""
    found = {}
    for line in section(title).splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        for name in re.findall(r"`(\w+)`", cells[0]) if line.startswith("| `") else ():
            found[name] = cells[1]
    return found


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> ParquetDataset:
    place = tmp_path_factory.mktemp("anatomy") / "data"
    joints = tuple(Joint(name, "rad", -1.0, 1.0, 1.0, 4.0) for name in ("one", "two"))
    robot = EmbodimentSpec("two", joints, (Camera("top", *SIZE),), rate_hz=10.0)
    with LeRobotWriter(place, fps=10, embodiment=robot) as writer:
        for n in range(FRAMES):
            row = np.full(S, n / FRAMES, np.float32)
            writer.add_frame({"top": np.full((*SIZE, 3), n, np.uint8)}, row, row, task="go")
        writer.save_episode(key=0)
    return ParquetDataset(str(place), [see], ["top"], T, embodiment_id=3)


SEEN: list[dict[str, object]] = []


def see(sample: dict[str, object]) -> dict[str, object]:
    """A transform that keeps what transforms are given."""
    SEEN.append(dict(sample))
    return sample


def test_every_top_level_name_is_explained() -> None:
    assert set(rows("Top-level names")) == {*_NAMED, "_base_"} - {"inference_model"}


def test_a_sample_is_as_the_table_says(data: ParquetDataset) -> None:
    after = data.get_sample(FRAMES - 1, 0)
    table, before = rows("What a sample holds"), SEEN[-1]
    assert set(table) == set(before)
    assert set(before) - set(after) == {"stats"}
    for name, value in before.items():
        if isinstance(value, np.ndarray):
            assert str(value.dtype) in table[name], name
            sizes = {"N": 1, "S": S, "D": S, "T": T}
            shape = re.findall(r"`\((.*?)\)`", table[name])[0].replace(",", " ").split()
            assert value.shape == tuple(sizes[size] for size in shape), name
    assert before["images"][0].shape == (3, *SIZE)
    assert after["images"].shape == (3, *SIZE)
    np.testing.assert_array_equal(before["action_masks"], [1, 0, 0, 0])


def test_the_statistics_have_the_keys_that_are_shown(data: ParquetDataset) -> None:
    text = section("Statistics")
    assert set(data.statistics) == {"private"}
    for name, entry in data.statistics["private"].items():
        assert f'"{name}":' in text
        shown = re.findall(r'"(\w+)": \[', text)
        assert set(shown) == set(entry)


def test_what_predict_action_may_get_is_listed() -> None:
    text = section("What a model gets and returns")
    for key in (*_KEYS, "noise", "prev_actions", "prefix_weights", "prefix_len"):
        assert f"`{key}`" in text
