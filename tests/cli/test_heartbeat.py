"""Commands that print their result alone do not stay silent while they work."""

from __future__ import annotations

import sys
import time

import pytest

from fluxvla_core.cli.main import main
from fluxvla_core.cli.reporters import EVERY_S, heartbeat


def slowly(*args: object, **kwargs: object) -> None:
    until = time.monotonic() + 20.0
    # capsys keeps what was said in memory, and readouterr would take it away.
    while "since: " not in sys.stderr.getvalue():  # type: ignore[union-attr]
        assert time.monotonic() < until, "nothing was said"
        time.sleep(0.02)
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("words", "slow", "said"),
    [
        (["export", "a", "b"], "fluxvla_core.training.export.export", "exporting a"),
        (
            ["export", "a", "b", "--format", "x"],
            "fluxvla_core.training.export.export_foreign",
            "exporting a",
        ),
        (
            ["import-checkpoint", "a", "b"],
            "fluxvla_core.training.export.import_checkpoint",
            "importing a",
        ),
        (
            ["eval", "compare", "a", "b"],
            "fluxvla_core.evaluation.compare.read",
            "comparing a with b",
        ),
        (["report", "a"], "fluxvla_report.page.build_report", "writing the report of a"),
    ],
)
def test_long_work_is_not_silent(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    slow: str,
    said: str,
) -> None:
    monkeypatch.setattr(slow, slowly)
    monkeypatch.setattr(heartbeat.__wrapped__, "__defaults__", (0.1,))  # type: ignore[attr-defined]
    assert main(words) == 130
    ended = capsys.readouterr()
    assert f"since: {said}" in ended.err
    assert ended.out == ""


def test_short_work_says_nothing_besides(capsys: pytest.CaptureFixture[str]) -> None:
    assert heartbeat.__wrapped__.__defaults__ == (EVERY_S,)  # type: ignore[attr-defined]
    with heartbeat("counting"):
        pass
    assert capsys.readouterr() == ("", "")
