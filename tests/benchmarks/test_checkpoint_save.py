"""The benchmark of saving: what it reads of a training that saves in the background."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch")

from benchmarks import checkpoint_save


def test_every_save_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "found.json"
    words = ["--gigabytes", "0.02", "--saves", "2", "--steps", "3", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["checkpoint_save", *words])
    monkeypatch.chdir(tmp_path)

    assert checkpoint_save.main() == 0
    found = json.loads(out.read_text())
    assert len(found["saves"]) == 2
    assert all(save["plain_s"] > 0 and save["blocked_s"] > 0 for save in found["saves"])
    assert found["step_s"] > 0
