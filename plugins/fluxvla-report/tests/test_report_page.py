"""The page shows what there is, says what is not, and stands alone."""

from __future__ import annotations

import json
import math
import re
import shutil
from pathlib import Path

import pytest
from fluxvla_report import build_report
from fluxvla_report.command import Report
from fluxvla_report.facts import Training, Video
from fluxvla_report.page import VideoSources, curves, running_mean

from fluxvla_core.cli.main import main

from .report_pages import Page, little, page_of


def test_a_complete_run(complete: Path, tmp_path: Path) -> None:
    page = page_of(complete, tmp_path)
    for words in (
        "two arms",
        "trained policy succeeds 85% 34 of 40 episodes, interval 71% to 93%",
        "untrained policy succeeds 0%",
        # Its instruction is not that of the scene's task: it is scored by the instruction.
        "wrong instruction: follows the instruction 100% 40 of 40 episodes",
        "The same task, side by side",
        "evaluated 2026-01-02 03:04:05 UTC · commit abc123 · mujoco 3.3.0 How it was evaluated",
        "machine x86_64, 2 CPUs versions mujoco 3.3.0",
        "300",
        "11280 frames, 2 instructions, LeRobot v3.0",
        "On the robot: lift the cube & hold it",
        "left_waist (rad) · 3 changed by a limit",
        "wrong instruction hand it over 20 1 1",
        "total time 15 min",
        "train · 10 min 01 s",
        "2.13.0+cpu",
        "fluxvla-aloha 0.1.0",
        '"note": "<b>"',
    ):
        assert page.shows(words), words
    assert not page.shows("wrong instruction succeeds")
    assert not page.shows("No metrics.jsonl")
    assert not page.shows("Not evaluated yet")
    assert "fluxvla-aloha 0.1.0, fluxvla-aloha" not in " ".join(page.text)


def test_a_folder_of_recordings(tmp_path: Path, complete: Path) -> None:
    root = tmp_path / "recordings"
    for number in range(6):
        shutil.copytree(complete / "inference" / "001-lift", root / f"{number + 1:03d}-lift")
    trace = root / "002-lift" / "trace.jsonl"
    stop = {"event": "stop", "t": 104.0, "rule": "chunk", "problem": "not finite", "seconds": 0.1}
    trace.write_text(trace.read_text() + json.dumps(stop) + "\n")
    page = page_of(root, tmp_path)
    for words in (
        "On the robot: 6 episodes",
        "6 of 6 judged ones succeeded",
        "18 commands; 1 safe stop",
        "The newest 4 follow.",
        "Timeline",
        "Latency by stage",
    ):
        assert page.shows(words), words
    assert not page.shows("Not evaluated yet")
    assert not page.shows("No metrics.jsonl")
    assert not page.shows("No environment.json")


def test_one_recording_with_a_stop(tmp_path: Path, complete: Path) -> None:
    root = tmp_path / "001-lift"
    shutil.copytree(complete / "inference" / "001-lift", root)
    summary = json.loads((root / "episode.json").read_text())
    summary |= {"outcome": "failed", "problem": "the chunk is not finite", "success": None}
    (root / "episode.json").write_text(json.dumps(summary))
    page = page_of(root, tmp_path)
    assert page.shows("On the robot: lift the cube & hold it")
    assert page.shows("failed the chunk is not finite")
    assert page.shows("none judged")


def test_it_stands_alone(complete: Path, tmp_path: Path) -> None:
    text = build_report(complete, tmp_path / "r.html").read_text(encoding="utf-8")
    page = Page(text)
    assert len(page.sources) == 7
    assert all(source.startswith("data:video/mp4;base64,") for source in page.sources)
    assert not re.search(r"https?://", text)


def test_live_results_are_shown_apart_from_stepped_ones(complete: Path, tmp_path: Path) -> None:
    work_dir = tmp_path / "run"
    shutil.copytree(complete, work_dir)
    results = json.loads((work_dir / "eval" / "results.json").read_text())
    live = {"ticks": 600, "missed_share": 0.125, "stopped_by": {"starvation": 2}}
    (work_dir / "eval_live").mkdir()
    (work_dir / "eval_live" / "results.json").write_text(
        json.dumps({**results, "mode": "live", "live": live})
    )
    page = Page(build_report(work_dir).read_text(encoding="utf-8"))
    assert page.text.count("Success on evaluation seeds") == 1
    assert page.text.count("Success on evaluation seeds, live") == 1
    assert page.shows("12.5% of 600 ticks without a target of the policy")
    assert page.shows("stopped by safety: starvation 2")


@pytest.mark.parametrize("unseen", [True, False, None])
def test_seeds_are_called_unseen_only_where_that_is_known(
    complete: Path, tmp_path: Path, unseen: bool | None
) -> None:
    work_dir = tmp_path / "run"
    shutil.copytree(complete, work_dir)
    path = work_dir / "eval" / "results.json"
    tested = {"pairs": 40, "p_different": 0.001, "verdict": "a difference"}
    more = {"provenance": {"unseen_seeds": unseen}, "instruction_test": tested}
    path.write_text(json.dumps({**json.loads(path.read_text()), **more}))
    page = Page(build_report(work_dir).read_text(encoding="utf-8"))
    assert ("Success on unseen seeds" in page.text) is (unseen is True)
    assert ("Success on evaluation seeds" in page.text) is (unseen is not True)
    assert page.shows("40 pairs, exact McNemar test: p = 0.001, a difference")


def test_what_went_wrong_in_episodes_stands_beside_their_rates(
    complete: Path, tmp_path: Path
) -> None:
    work_dir = tmp_path / "run"
    shutil.copytree(complete, work_dir)
    path = work_dir / "eval" / "results.json"
    rows = [
        {"group": "policy", "status": "done", "what": "chunk is not finite", "episodes": 3},
        {"group": "swapped", "status": "error", "what": "KeyError: 'qpos'", "episodes": 1},
        *[{"group": "x", "status": "done", "what": f"reason {n}", "episodes": 2} for n in range(5)],
    ]
    path.write_text(json.dumps({**json.loads(path.read_text()), "problems": rows}))
    page = Page(build_report(work_dir).read_text(encoding="utf-8"))
    assert page.shows("trained policy: 3 episodes failed: chunk is not finite")
    assert page.shows("wrong instruction: 1 episode gave no result: KeyError: 'qpos'")
    assert page.shows("reason 2")
    assert not page.shows("reason 3")
    assert page.shows("2 more problems are in")


def test_the_mean_return_is_shown_where_there_is_one(complete: Path, tmp_path: Path) -> None:
    assert not page_of(complete, tmp_path).shows("mean return")
    work_dir = tmp_path / "with_returns"
    shutil.copytree(complete, work_dir)
    path = work_dir / "eval" / "results.json"
    results = json.loads(path.read_text())
    next(iter(results["groups"].values()))["all"]["mean_return"] = -12.5
    path.write_text(json.dumps(results))
    page = page_of(work_dir, tmp_path)
    assert page.shows("mean return")
    assert page.shows("-12.5")


def test_videos_beyond_the_limit_are_linked(tmp_path: Path) -> None:
    for name, size in (("a", 60), ("b", 50), ("c", 30)):
        (tmp_path / f"{name}.mp4").write_bytes(b"x" * size)
    videos = VideoSources(tmp_path / "sub", room=100)
    sources = [videos.put(Video(tmp_path / f"{n}.mp4", "", None))["src"] for n in "abca"]
    assert sources[0].startswith("data:")
    assert sources[1] == "../b.mp4"
    assert sources[2].startswith("data:")
    assert sources[3] == sources[0]
    assert videos.room == 10


def test_the_title_can_be_given(tmp_path: Path) -> None:
    little(tmp_path / "my_work")
    assert "<h1>my work</h1>" in build_report(tmp_path / "my_work").read_text()
    assert "<h1>A &amp; B</h1>" in build_report(tmp_path / "my_work", title="A & B").read_text()


def test_every_column_of_a_training_has_a_chart() -> None:
    """What is measured at few steps is drawn from one to the next, and noise with its mean."""
    steps = [float(n) for n in range(1, 41)]
    nan = [math.nan] * 40
    sparse = [1.0 / n if n % 10 == 0 else math.nan for n in range(1, 41)]
    training = Training(
        steps,
        {
            "time": steps,
            "loss": [1.0 / n for n in steps],
            "loss/cubes": [2.0 / n for n in steps],
            "val_loss": sparse,
            "data_wait": [0.1] * 40,
            "mfu": nan,
            "memory_gb": [1.5] * 40,
        },
    )
    found = {chart["name"]: chart for chart in curves(training)}
    assert list(found) == [
        "Loss",
        "Loss on cubes",
        "Validation loss",
        "Share of time spent waiting for data",
        "Memory (GB)",
    ]
    assert [chart["smoothed"] for chart in found.values()] == [True, True, False, True, False]
    assert 'd="M48.0 10.0L201.3' in found["Validation loss"]["svg"]


def test_the_running_mean_skips_gaps() -> None:
    assert running_mean([math.nan, 2.0, math.nan, 4.0], share=0.0)[1:] == [2.0, 2.0, 4.0]
    assert math.isnan(running_mean([math.nan])[0])


def test_the_command(complete: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:

    out = tmp_path / "page.html"
    assert main(["report", str(complete), "--out", str(out), "--title", "T"]) == 0
    assert capsys.readouterr().out.strip() == str(out)
    assert "<h1>T</h1>" in out.read_text()
    assert main(["report", str(tmp_path / "nowhere")]) == 2
    assert "there is no such work dir" in capsys.readouterr().err
    assert Report.api == "1.0"


def test_latencies_of_simulated_time_are_left_out(tmp_path: Path, complete: Path) -> None:
    root = tmp_path / "recordings"
    shutil.copytree(complete / "inference" / "001-lift", root / "001-lift")
    trace = root / "001-lift" / "trace.jsonl"
    start, *rest = trace.read_text().splitlines()
    trace.write_text("\n".join([json.dumps({**json.loads(start), "lockstep": True}), *rest]) + "\n")
    page = page_of(root, tmp_path)

    assert page.shows("Time was simulated")
    assert not page.shows("Latency by stage")
    assert not page.shows("observation to command")


def test_a_summary_alone_says_that_time_was_simulated(tmp_path: Path, complete: Path) -> None:
    """As a simulation leaves it whose record has no event of its beginning."""
    folder = tmp_path / "recordings" / "001-lift"
    shutil.copytree(complete / "inference" / "001-lift", folder)
    summary = json.loads((folder / "episode.json").read_text())
    (folder / "episode.json").write_text(json.dumps({**summary, "lockstep": True}))
    lines = (folder / "trace.jsonl").read_text().splitlines()
    (folder / "trace.jsonl").write_text("\n".join(lines[1:]) + "\n")
    page = page_of(folder.parent, tmp_path)

    assert page.shows("Time was simulated")
    assert not page.shows("Latency by stage")


def test_a_narrow_page_stacks_its_tables_and_scrolls_no_chart(
    complete: Path, tmp_path: Path
) -> None:
    html = build_report(complete, tmp_path / "page.html").read_text(encoding="utf-8")

    assert "overflow-x" not in html
    for table in re.findall(r'<table class="stack">.*?</table>', html, re.DOTALL):
        # The heads are hidden there: each figure says what it is.
        head, cells = table.count("<th class="), re.findall(r'<td class="number"[^>]*>', table)
        assert cells
        assert head == 0 or all("data-label=" in cell for cell in cells)


NARROW = 420.0


INSIDE = NARROW - 2 * (12 + 14) - 2


"""Pixels of a section of a narrow page: without the paddings of both, and the section's borders."""


LEGIBLE = 9.0


def declarations(css: str) -> dict[str, dict[str, str]]:
    """What a page of less than 640 pixels is drawn by: selector -> property -> value."""
    wide, _, narrow = css.partition("@media (max-width: 640px) {")
    narrow = narrow.partition("\n}\n")[0]
    found: dict[str, dict[str, str]] = {}
    for selectors, body in re.findall(r"([^{}]+)\{([^{}]*)\}", wide + narrow):
        for selector in selectors.split(","):
            rule = found.setdefault(" ".join(selector.split()), {})
            rule |= {
                name.strip(): value.strip()
                for name, _, value in (line.partition(":") for line in body.split(";"))
            }
    return found


def test_nothing_is_wider_than_a_page_of_420_pixels(complete: Path, tmp_path: Path) -> None:
    html = build_report(complete, tmp_path / "page.html").read_text(encoding="utf-8")
    rules = declarations(html.partition("<style>")[2].partition("</style>")[0])
    assert '<meta name="viewport" content="width=device-width, initial-scale=1">' in html
    assert rules["main"]["padding"] == "20px 12px 48px"
    assert rules["section"]["padding"] == "16px 14px"
    for selector, rule in rules.items():
        for name in ("width", "min-width", "flex-basis", "grid-template-columns"):
            # min(100%, …) is never wider than what it stands in.
            value = re.sub(r"min\(100%, \d+px\)", "", rule.get(name, ""))
            widths = [float(number) for number in re.findall(r"([\d.]+)px", value)]
            assert sum(widths) <= INSIDE, f"{selector}: {name}: {rule[name]}"
    assert re.findall(r"<(?:svg|table|video|div|figure)[^>]*\bwidth\s*[=:]", html) == []


def test_charts_are_legible_on_a_page_of_420_pixels(complete: Path, tmp_path: Path) -> None:
    html = build_report(complete, tmp_path / "page.html").read_text(encoding="utf-8")
    rules = declarations(html.partition("<style>")[2].partition("</style>")[0])
    assert rules["svg"]["width"] == "100%"
    seen = 0
    for place in ("grid", "joints"):
        size = rules.get(f".{place} svg text", rules["svg text"])["font-size"]
        _, _, drawn = html.partition(f'<div class="{place}">')
        for width in re.findall(r'viewBox="0 0 (\d+) ', drawn.partition("</div>")[0]):
            seen += 1
            assert float(size.removesuffix("px")) * INSIDE / float(width) >= LEGIBLE, place
    assert seen > 5


def test_the_policy_stands_beside_the_wrong_instruction_and_the_untrained_one(
    complete: Path, tmp_path: Path
) -> None:
    html = build_report(complete, tmp_path / "page.html").read_text(encoding="utf-8")
    rules = declarations(html.partition("<style>")[2].partition("</style>")[0])
    _, _, after = html.partition("The same task, side by side")
    row, _, more = after.partition('<div class="videos wide">')[2].partition("</div>")
    said = re.findall(r"<figcaption>(.*?)</figcaption>", row, re.DOTALL)
    assert [words.split("·")[0].split(">")[-1].strip() for words in said] == [
        "trained policy", "wrong instruction", "untrained policy",
    ]  # fmt: skip
    assert "chip good" in said[0], "a success, where there is one"
    assert row.count("<video") == 3
    # Three fit a page of 1120 pixels, and each of the others has 440.
    assert "min(100%, 300px)" in rules[".videos.wide"]["grid-template-columns"]
    assert "min(100%, 440px)" in rules[".videos"]["grid-template-columns"]
    assert '<div class="videos ">' in more


def test_an_episode_that_nobody_judges_is_no_failure(complete: Path, tmp_path: Path) -> None:
    root = tmp_path / "recordings"
    for number, success in enumerate((None, True)):
        folder = shutil.copytree(complete / "inference" / "001-lift", root / f"00{number}-wave")
        summary = json.loads((folder / "episode.json").read_text())
        (folder / "episode.json").write_text(json.dumps({**summary, "success": success}))
    html = build_report(root, tmp_path / "page.html").read_text(encoding="utf-8")
    page = Page(html)
    assert page.shows("1 of 1 judged ones succeeded")
    assert 'class="chip bad"' not in html
    assert not page.shows("failure")
    (wave,) = re.findall(r'<section id="000-wave">.*?</section>', html, re.DOTALL)
    assert "chip" not in wave


def test_a_title_stands_with_its_plot(complete: Path, tmp_path: Path) -> None:
    html = build_report(complete, tmp_path / "page.html").read_text(encoding="utf-8")

    for name in ("left_waist", "Loss"):
        before = html.partition(f"{name}: command and state</title>" if "_" in name else
                                f"{name} over the steps</title>")[0]  # fmt: skip
        figure = before.rpartition("<figure>")[2]
        assert name in figure, "the title is above the plot, and in its figure"
        assert "</figure>" not in figure


def test_a_few_values_are_said_in_words() -> None:
    training = Training([1.0, 2.0], {"loss": [0.5, 0.25]})
    (chart,) = curves(training)
    assert (chart["svg"], chart["text"]) == ("", "0.5 at step 1, 0.25 at step 2")
