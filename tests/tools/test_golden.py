"""Which programs write golden files, and what counts as the same."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from tools import golden, oracle_env, project


def test_every_golden_file_of_the_repository_has_a_program_with_an_environment() -> None:
    found = golden.programs()
    assert {p.environment for p in found} <= {*oracle_env.ENVIRONMENTS, None}
    by_hand = [p.path.read_text(encoding="utf-8") for p in found if p.environment is None]
    assert all("environment with" in text.split('"""')[1] for text in by_hand)
    guide = (project.ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    listed = {p.path.relative_to(project.ROOT).as_posix() for p in found if p.environment is None}
    assert set(re.findall(r"^\| `(plugins/\S+/make_\w+\.py)` \|", guide, re.MULTILINE)) == listed
    folders = set(project.ROOT.glob("plugins/*/tests/golden"))
    assert folders == {p.golden for p in found}


def test_a_program_without_an_environment(tmp_path: Path) -> None:
    path = tmp_path / "plugins" / "a" / "tests" / "oracles" / "make_it.py"
    path.parent.mkdir(parents=True)
    path.write_text('ENVIRONMENT = "lerobot061"\n', encoding="utf-8")
    (program,) = golden.programs(tmp_path)
    assert program.environment == "lerobot061"
    assert program.golden == tmp_path / "plugins" / "a" / "tests" / "golden"
    path.write_text("import this\n", encoding="utf-8")
    assert golden.programs(tmp_path) == [golden.Program(path, None)]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({}, None),
        ({"x": np.array([1.0, -2.00001], np.float32)}, None),
        ({"x": np.array([1.0, -2.0001], np.float32)}, "x: .* apart, at most 2e-05"),
        ({"x": np.array([1.0, np.nan], np.float32)}, "x: nan apart"),
        ({"x": np.array([1.0], np.float32)}, r"x: float32 \(1,\), committed float32 \(2,\)"),
        ({"n": np.array([4])}, "n: 1 apart, at most 0"),
        ({"bf16.x": np.array([1.0, -2.05], np.float32)}, None),
        ({"bf16.x": np.array([1.0, -2.2], np.float32)}, "bf16.x: .* apart, at most 0.1"),
        ({"y": np.array([4])}, "y: only in one"),
    ],
)
def test_arrays(change: dict[str, np.ndarray], told: str | None) -> None:
    committed = {"x": np.array([1.0, -2.0], np.float32), "n": np.array([3])}
    committed["bf16.x"] = committed["x"]
    found = golden.compared({**committed, **change}, committed)
    assert len(found) == (told is not None)
    if told is not None:
        assert re.match(told, found[0])


def test_folders(tmp_path: Path) -> None:
    for name in ("made", "committed"):
        (tmp_path / name).mkdir()
        save_file({"x": np.ones(2, np.float32)}, tmp_path / name / "same.safetensors")
    assert golden.differences(tmp_path / "made", tmp_path / "committed") == []
    save_file({"x": np.ones(2, np.float32)}, tmp_path / "made" / "new.safetensors")
    save_file({"x": np.ones(2, np.float32)}, tmp_path / "committed" / "old.safetensors")
    save_file({"x": np.zeros(2, np.float32)}, tmp_path / "made" / "same.safetensors")
    found = golden.differences(tmp_path / "made", tmp_path / "committed")
    assert [line.partition(":")[0] for line in found] == [
        "old.safetensors",
        "new.safetensors",
        "same.safetensors",
    ]
    assert golden.differences(tmp_path / "made", tmp_path / "committed", some=True) == found[1:]
