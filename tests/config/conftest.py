"""Files to load, and parsed sources forgotten between tests (module names come back)."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fluxvla_core.config import source

Write = Callable[[str, str], Path]


@pytest.fixture(autouse=True)
def _fresh_sources() -> Iterator[None]:
    source.parse.cache_clear()
    yield
    source.parse.cache_clear()


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """``write("a.py", text)`` puts a dedented file into an empty working directory."""
    folder = tmp_path / "cwd"
    folder.mkdir()
    monkeypatch.chdir(folder)

    def make(name: str, text: str) -> Path:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text), encoding="utf-8")
        return Path(name)

    return make
