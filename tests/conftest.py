"""Fake installed distributions: metadata and modules in a folder that is put on ``sys.path``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fluxvla_core.plugins import _metadata
from fluxvla_core.plugins.registry import BY_NAME

Install = Callable[..., Path]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Call ``install("fluxvla-x", entry_points="…", files={"x.py": "…"})``; gives its dist-info."""
    site = tmp_path / "site"
    site.mkdir()
    monkeypatch.syspath_prepend(str(site))

    def make(
        dist: str,
        *,
        version: str = "1.0",
        entry_points: str | bytes = "",
        files: dict[str, str] | None = None,
        requires: tuple[str, ...] = (),
        metadata: bool = True,
        folder: str | None = None,
    ) -> Path:
        info = site / (folder or f"{dist.replace('-', '_')}-{version}.dist-info")
        info.mkdir()
        if metadata:
            lines = ["Metadata-Version: 2.1", f"Name: {dist}", f"Version: {version}"]
            lines += [f"Requires-Dist: {r}" for r in requires]
            (info / "METADATA").write_text("\n".join(lines) + "\n")
        raw = entry_points.encode() if isinstance(entry_points, str) else entry_points
        (info / "entry_points.txt").write_bytes(raw)
        for name, text in (files or {}).items():
            (site / name).parent.mkdir(parents=True, exist_ok=True)
            (site / name).write_text(text)
        _metadata.index.cache_clear()
        return info

    yield make
    # Its own modules alone: one of the core's that were first imported meanwhile stays.
    for name in [n for n, m in sys.modules.items() if _is_in(m, site)]:
        del sys.modules[name]
    _metadata.index.cache_clear()
    for registry in BY_NAME.values():
        registry._loaded.clear()
        registry._failed.clear()


def _is_in(module: object, site: Path) -> bool:
    file = getattr(module, "__file__", None)
    places = [file] if file else list(getattr(module, "__path__", ()))
    return any(Path(place).is_relative_to(site) for place in places)
