"""Reports of damaged, hostile or nearly empty work dirs, and reports that cannot be written."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
from fluxvla_report import build_report

from fluxvla_core.cli.main import main
from fluxvla_core.errors import RunFailed, UsageError

from .report_pages import little, page_of


def test_a_folder_without_a_run_is_refused_with_those_below_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demo_out" / "default" / "work" / "eval").mkdir(parents=True)
    assert main(["report", "demo_out"]) == 2
    assert capsys.readouterr().err.endswith("next: name the work dir that a run said at its end\n")
    for place in ("demo_out/default/work", "demo_out/default/work/eval"):
        Path(place, "config.resolved.json").write_text("{}")
    assert main(["report", "demo_out"]) == 2
    assert capsys.readouterr().err == (
        "demo_out: nothing to report on: no training, evaluation or episode of fluxvla run is in "
        "this folder\n  next: fluxvla report demo_out/default/work\n"
    )
    assert not Path("demo_out/report.html").exists()


def test_a_work_dir_of_little_says_what_is_not_there(tmp_path: Path) -> None:
    little(tmp_path / "work")
    page = page_of(tmp_path / "work", tmp_path)
    for words in (
        "Not evaluated yet. To do it: fluxvla run --config … --section eval",
        "No metrics.jsonl in the work dir",
        "No episode was run yet. To do it: fluxvla run --config … --section inference",
        "No environment.json in the work dir",
        "No config.resolved.json in the work dir",
    ):
        assert page.shows(words), words


def test_damaged_files_are_listed(tmp_path: Path) -> None:
    (little(tmp_path / "work") / "environment.json").write_text("{")
    assert page_of(tmp_path / "work", tmp_path).shows("environment.json: invalid JSON")


def test_what_a_run_names_cannot_become_markup(tmp_path: Path) -> None:
    folder = tmp_path / "work" / "inference" / "001-x"
    folder.mkdir(parents=True)
    evil = "<script>alert(1)</script>"
    summary = {"instruction": evil, "outcome": evil, "problem": evil, "joints": [evil]}
    (folder / "episode.json").write_text(json.dumps(summary))
    event = {"event": "command", "t": 0, "command": [1.0], "state": [1.0], "clamps": []}
    (folder / "trace.jsonl").write_text(json.dumps(event) + "\n")
    text = build_report(tmp_path / "work").read_text(encoding="utf-8")
    assert "<script" not in text
    assert "&lt;script&gt;" in text


def test_there_is_no_such_folder(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="there is no such work dir to report on"):
        build_report(tmp_path / "nowhere")


def test_it_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match="cannot write to the report's folder") as found:
        build_report(little(tmp_path), tmp_path / "file" / "r.html")
    assert f"{tmp_path}/file" in str(found.value)


def test_the_disk_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, text: str) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("fluxvla_report.page.write_text", full)
    with pytest.raises(RunFailed, match=r"the report cannot be written: .*No space left"):
        build_report(little(tmp_path))


def test_a_pipe_among_the_videos_keeps_nobody_waiting(complete: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(complete / "inference" / "001-lift", tmp_path / "001-lift")
    (folder / "top.mp4").unlink()
    os.mkfifo(folder / "top.mp4")
    assert "<video" not in build_report(folder, tmp_path / "page.html").read_text(encoding="utf-8")
