"""docs/files.md lists the keys of the files that runs write."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from fluxvla_core.build import RunContext
from fluxvla_core.checkpoints.writer import free_name
from fluxvla_core.evaluation import robot, runner
from fluxvla_core.evaluation.runner import EvalRunner
from fluxvla_core.robot.recording import trace
from fluxvla_core.robot.recording.episode_log import HELD, EpisodeSummary
from tests.evaluation.conftest import walking

__all__ = ["walking"]

PAGE = Path(__file__).parents[2] / "docs" / "files.md"
LIVE = {"outcome", "ticks", "late_ticks", "missed_ticks", "skipped_ticks", "trips", "record"}


def documented(title: str) -> set[str]:
    """The keys in the first column of a section's table."""
    section = PAGE.read_text(encoding="utf-8").partition(f"\n## {title}\n")[2].partition("\n## ")[0]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    assert rows, f"there is no table below {title!r}"
    return {key for row in rows for key in re.findall(r"`([^`]+)`", row)}


@pytest.fixture
def evaluated(tmp_path, walking):
    """Folder of an evaluation."""

    def run(**options):
        context = RunContext(work_dir=tmp_path, section="eval")
        environment = {"type": "Walk", **({"limited": True} if options else {})}
        runner = EvalRunner(
            context=context, environment=environment, policy="expert", episodes=1, **options
        )
        runner.run_setup()
        runner.run()
        return runner.folder

    return run


@pytest.mark.parametrize("live", [False, True])
def test_an_evaluations_files_have_the_keys_that_are_documented(evaluated, live):
    folder = evaluated(**({"live": True} if live else {}))
    results = json.loads((folder / "results.json").read_text())
    keys = documented("`results.json`")
    tables = {key.partition(".")[0] for key in keys}
    assert set(results) == tables - ({"live"} if not live else set())
    text = PAGE.read_text(encoding="utf-8")
    parts = ("provenance", "timing", *(["live"] if live else []))
    counted = results["groups"]["policy"]["all"]
    missing = {k for part in parts for k in results[part] if f"`{k}`" not in text}
    assert not missing | {key for key in counted if f"`{key}`" not in text}
    _, episode, *_ = (folder / "episodes.jsonl").read_text().splitlines()
    written = set(json.loads(episode))
    in_table = documented("`episodes.jsonl`")
    assert written <= in_table
    optional = {"error", "behaviours", "images"}
    expected = in_table - optional - (LIVE if not live else {"clamped", "return", "state_hash"})
    assert expected <= written


def test_files_that_only_some_runs_write_are_listed(tmp_path):
    table = PAGE.read_text(encoding="utf-8").partition("## Work dir")[2].partition("\n## ")[0]
    names = {runner.FOLDER, runner.LIVE_FOLDER, robot.FOLDER, free_name(tmp_path / "x").suffix}
    names |= {trace.EVENTS_FILE, trace.SUMMARY_FILE, trace.REST_FILE, HELD}
    assert {name for name in names if name not in table} == set()


def test_an_episodes_summary_has_the_keys_that_are_documented():
    # What was dropped is counted by what writes the file.
    assert {*EpisodeSummary().to_dict(), "dropped"} == documented("`episode.json`")
