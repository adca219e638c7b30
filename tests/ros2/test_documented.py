"""The tests that docs/ros2.md names are there."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_every_test_that_the_page_names_exists():
    page = (ROOT / "docs" / "ros2.md").read_text(encoding="utf-8")
    named = re.findall(r"`(test_\w+\.py)::(\w+)`", page)

    assert len(named) > 15
    for file, test in named:
        text = (ROOT / "tests" / "ros2" / file).read_text(encoding="utf-8")
        assert f"def {test}(" in text, f"{file}::{test}"
