"""Two episodes of the simulated ALOHA, on which every family trains."""

from __future__ import annotations

from pathlib import Path

import pytest

from fluxvla_core.cli.main import main

from .tiny import CAMERAS, HEIGHT, WIDTH


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("data") / "aloha"
    sizes = ["--height", str(HEIGHT), "--width", str(WIDTH)]
    words = ["--tasks", "lift_hold", "--episodes", "2", "--workers", "1", "--cameras", *CAMERAS]
    assert main(["collect", "aloha", "--out", str(out), *words, *sizes]) == 0
    return out
