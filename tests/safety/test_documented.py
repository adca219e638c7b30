"""The tests that docs/safety.md names are there."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_every_test_that_the_page_names_exists():
    page = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:tests/\w+/)?test_\w+\.py)(?:::(\w+))?`", page)

    assert len(named) > 20
    for file, test in named:
        path = ROOT / file if "/" in file else ROOT / "tests" / "infer" / file
        assert path.exists(), file
        assert f"def {test}(" in path.read_text(encoding="utf-8") if test else True, test
