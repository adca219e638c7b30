"""Files from elsewhere: bounds, types, one error each."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import pytest

from fluxvla_core.errors import DataError
from fluxvla_core.results import parse_json, read_bytes, read_json
from fluxvla_core.untrusted import checked


@dataclass(frozen=True)
class Feature:
    dtype: str
    shape: tuple[int, ...]


@dataclass(frozen=True)
class Info:
    fps: float
    features: dict[str, Feature]


def test_the_file_is_read_as_the_type(tmp_path: Path) -> None:
    file = tmp_path / "info.json"
    file.write_text('{"fps": 30, "features": {"a": {"dtype": "f", "shape": [2]}}, "more": 1}')
    assert read_json(file, Info, DataError) == Info(30.0, {"a": Feature("f", (2,))})


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ('{"fps": "30", "features": {}}', ["fps", "number"]),
        ('{"fps": true, "features": {}}', ["fps", "number"]),
        ('{"fps": 30}', ["features", "required"]),
        ('{"fps": 3, "features": {"a": {"dtype": 3, "shape": [1]}}}', ["features.a.dtype"]),
        ('{"fps": 3, "features": {"a": {"dtype": "f", "shape": [1.5]}}}', ["features.a.shape.0"]),
        ("[" * 100_000, ["recursion limit"]),
        ("[" * 100_000 + "]" * 100_000, ["recursion limit"]),
        ('{"fps": 3, "features": {"a": ' + "[" * 900 + "]" * 900 + "}}", ["recursion limit"]),
        ('{"fps": ' + "9" * 5000 + ', "features": {}}', ["number out of range"]),
        ('{"fps": 3, "features": {"\\ud800": 1}}', ["JSON"]),
        ("3", ["object"]),
        ("", ["JSON"]),
        ("\x00", ["JSON"]),
    ],
)
def test_what_is_wrong_is_named(text: str, facts: list[str]) -> None:
    with pytest.raises(DataError) as caught:
        parse_json(text, Info, DataError, "info.json")
    said = str(caught.value)
    assert said.startswith("info.json: ")
    assert all(fact in said for fact in facts), said
    assert len(said) < 400


def test_many_problems_are_counted() -> None:
    features = {str(i): 3 for i in range(1000)}
    with pytest.raises(DataError, match="and 995 more"):
        checked({"fps": 1.0, "features": features}, Info, DataError, "here")


def test_a_pipe_does_not_wait(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(DataError, match="not a regular file"):
        read_bytes(pipe, DataError)


def test_a_device_is_not_read() -> None:
    with pytest.raises(DataError, match="not a regular file"):
        read_bytes(Path("/dev/zero"), DataError)


def test_a_folder_and_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=str(tmp_path)):
        read_bytes(tmp_path, DataError)
    with pytest.raises(DataError, match="No such file"):
        read_bytes(tmp_path / "missing", DataError)


def test_a_link_to_itself(tmp_path: Path) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    with pytest.raises(DataError, match="symbolic links"):
        read_bytes(loop, DataError)


def test_the_size_has_a_bound(tmp_path: Path) -> None:
    file = tmp_path / "large"
    with file.open("wb") as large:
        large.truncate(3 << 20)
    with pytest.raises(DataError, match="more than 2 MiB"):
        read_bytes(file, DataError, at_most=2 << 20)
