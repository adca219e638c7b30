"""What a command says to bad input, for any family of models."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from fluxvla_core.cli.main import main

STATISTICS = ("mean", "std", "min", "max", "q01", "q99")


def refused(words: Sequence[object], capsys: Any) -> str:
    """The one message that a command ends with: exit code 2, and no traceback."""
    assert main([str(word) for word in words]) == 2
    said = str(capsys.readouterr().err)
    assert "Traceback" not in said
    return said


def import_refused(source: Path, words: Sequence[object], capsys: Any) -> str:
    """As ``refused``, of an import of ``source``, which leaves nothing behind."""
    target = source.parent / "refused"
    said = refused(["import-checkpoint", source, target, *words], capsys)
    assert not list(source.parent.glob("refused*"))
    return said


def checked_with_transformers(version: str, config: Path, folder: Path) -> str:
    """What ``fluxvla config check`` says where ``version`` of transformers is installed."""
    info = folder / f"transformers-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: transformers\nVersion: {version}\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "fluxvla_core", "config", "check", str(config)],
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    return done.stderr


def change_json(file: Path, change: Callable[[Any], object]) -> None:
    """Change what ``file`` holds."""
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def change_rows(file: Path, change: Callable[[dict[str, Any], str], object]) -> None:
    """Call ``change(table, name)`` for every row of statistics in ``file``."""

    def walk(table: dict[str, Any]) -> None:
        for name in list(table):
            if name in STATISTICS and isinstance(table[name], list):
                change(table, name)
            elif isinstance(table[name], dict):
                walk(table[name])

    change_json(file, walk)


def drop(*names: str) -> Callable[[dict[str, Any], str], object]:
    """Take the statistics ``names`` out."""
    return lambda table, name: table.pop(name) if name in names else None


def spoil(value: object) -> Callable[[dict[str, Any], str], object]:
    """Put ``value`` in the place of the first number of each row."""
    return lambda table, name: table[name].__setitem__(0, value)


def widen(table: dict[str, Any], name: str) -> None:
    """One dimension more."""
    table[name].append(table[name][-1])


def shorten(*names: str) -> Callable[[dict[str, Any], str], object]:
    """One number less in the statistics ``names``."""
    return lambda table, name: table[name].pop() if name in names else None
