"""Reading a work dir: whole, in part and damaged."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from fluxvla_report.episodes import clamp_counts, joint_traces, phases, read_episodes, stops
from fluxvla_report.files import Reader, number, text_rows
from fluxvla_report.read import read_evaluations, read_facts


def test_a_complete_work_dir(complete: Path) -> None:
    facts = read_facts(complete)
    assert facts.problems == ()
    assert facts.training is not None
    assert facts.training.steps[-1] == 300
    assert set(facts.training.columns) >= {"loss", "lr", "grad_norm", "samples_per_s"}
    (evaluation,) = facts.evaluations
    assert [(g.name, g.total.successes, g.total.episodes) for g in evaluation.groups] == [
        ("policy", 34, 40),
        ("swapped", 2, 40),
        ("untrained", 0, 40),
    ]
    assert evaluation.groups[0].tasks[0].rate == 0.85
    assert evaluation.groups[0].total.low == pytest.approx(0.709, abs=1e-3)
    assert evaluation.details["checkpoint"] == "checkpoints/step-000000300"
    assert evaluation.details["speed"] == "300 steps/s in 2 processes, 120 episodes in 100 s"
    assert evaluation.details["policy call"] == "12.3 ms on average"
    assert evaluation.details["replan_every"] == 5
    assert evaluation.behaviours[1].group == "wrong instruction"
    assert evaluation.behaviours[1].counts == {"neither": 1, "lift_hold": 1}
    policys = [v.success for v in evaluation.videos if v.group == "policy"]
    assert policys == [False, False, True, True]
    (episode,) = facts.episodes
    assert (episode.task, episode.success) == ("lift the cube & hold it", True)
    assert len(episode.joints) == 6
    joint = episode.joints[0]
    assert (joint.name, joint.unit, len(joint.times)) == ("left_waist", "rad", 200)
    assert [round(time, 2) for time, _ in joint.clamped] == [1.0, 1.02, 1.04]
    assert episode.joints[1].clamped == []
    assert episode.notes["clamped commands"] == "left_waist 3 (velocity)"
    assert episode.timings["policy"]["p50_ms"] == 11.3
    assert [stage.name for stage in facts.stages] == ["install", "collect", "train", "evaluate"]
    assert facts.dataset["total_episodes"] == 240


def test_an_episode_of_version_0_1_is_read_under_its_former_keys(complete: Path) -> None:
    file = complete / "inference" / "001-lift" / "episode.json"
    summary = json.loads(file.read_text())
    del summary["skipped_ticks"]
    former = {"skipped_beats": 3, "held_beats": 2, "dropped": {"frames": 0, "pictures": 4}}
    file.write_text(json.dumps({**summary, **former}))
    (episode,) = read_facts(complete).episodes
    assert episode.notes["control ticks skipped"] == 3
    assert episode.notes["control ticks without a chunk, held"] == 2
    assert episode.notes["not recorded"] == "4 images"


def test_what_stopped_the_arm_after_an_episode_is_among_its_notes(complete: Path) -> None:
    (folder,) = (complete / "inference").iterdir()
    trip = {"time": 1.0, "rule": "tracking", "what": "waist is away", "at": 2.0, "failure": None}
    (folder / "held.jsonl").write_text(json.dumps(trip) + "\n")

    (episode,) = read_facts(complete).episodes
    assert episode.notes["trips while it was held"] == "tracking: waist is away"


def test_an_empty_work_dir(tmp_path: Path) -> None:
    facts = read_facts(tmp_path)
    assert facts.training is None
    assert facts.problems == ()
    assert [*facts.evaluations, *facts.episodes, *facts.stages, *facts.dataset] == []


def test_a_run_that_was_killed_leaves_half_a_line(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text('{"step": 1, "loss": 2}\n{"step": 2, "lo')
    facts = read_facts(tmp_path)
    assert facts.training is not None
    assert facts.training.steps == [1.0]
    assert facts.problems == ()


def test_damage_is_named_and_hurts_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text('{"step": 1}\n{]\n7\n{"step": 3, "loss": 1}\n')
    (tmp_path / "config.resolved.json").write_text("{")
    (tmp_path / "environment.json").write_text("[]")
    (tmp_path / "stages.json").write_bytes(b"\xff\xfe\x00")
    facts = read_facts(tmp_path)
    assert facts.training is not None
    assert facts.training.steps == [1.0, 3.0]
    assert math.isnan(facts.training.columns["loss"][0])
    problems = "\n".join(facts.problems)
    assert "metrics.jsonl: 2 line(s) are not JSON objects and were left out" in problems
    assert "config.resolved.json: invalid JSON" in problems
    assert "environment.json: input should be an object" in problems
    assert "stages.json: invalid JSON" in problems


def test_results_without_rates_or_with_missing_videos_show_what_there_is(tmp_path: Path) -> None:
    folder = tmp_path / "eval"
    folder.mkdir()
    empty = {"episodes": 0, "successes": 0, "low": 0.0, "high": 1.0, "errors": 3}
    groups = {"policy": {"all": empty, "tasks": {"a": empty}}, "strange": {"all": 7}}
    (folder / "results.json").write_text(json.dumps({"groups": groups}))
    assert read_evaluations(Reader(tmp_path), tmp_path) == []
    groups["acme"] = {"all": {**empty, "episodes": 2, "successes": 1}, "tasks": {}}
    videos = [{"group": "acme", "success": True, "path": "gone.mp4"}, {"group": "acme"}, 7]
    results = {"groups": groups, "policy": "expert", "videos": videos}
    (folder / "results.json").write_text(json.dumps(results))
    (evaluation,) = read_evaluations(Reader(tmp_path), tmp_path)
    assert [group.label for group in evaluation.groups] == ["acme"]
    assert evaluation.groups[0].total.rate == 0.5
    assert evaluation.videos == []


@pytest.mark.parametrize(
    ("mode", "label"),
    [
        ("stepped", "trained policy"),
        ("robot", "trained policy, on the robot"),
        ("live", "trained policy, in real time"),
    ],
)
def test_evaluations_of_one_policy_are_told_apart(tmp_path: Path, mode: str, label: str) -> None:
    (tmp_path / "eval").mkdir()
    counted = {"episodes": 2, "successes": 1, "low": 0.1, "high": 0.9, "errors": 0}
    results = {"mode": mode, "groups": {"policy": {"all": counted, "tasks": {}}}}
    (tmp_path / "eval" / "results.json").write_text(json.dumps(results))
    (evaluation,) = read_evaluations(Reader(tmp_path), tmp_path)
    assert [group.label for group in evaluation.groups] == [label]


def test_joints_of_a_trace_with_other_states() -> None:
    events: list[dict[str, Any]] = [
        {"event": "trip", "t": 0.0},
        {"event": "command", "t": 5.0, "command": [1.0], "state": [1.0, 2.0], "clamps": None},
        {"event": "command", "t": 5.5, "command": [1.0, 2.0], "state": [0.0]},
    ]
    (trace,) = joint_traces(["a"], events, {})
    assert trace.times == [0.0]
    assert math.isnan(trace.states[0])
    assert joint_traces([], events, {}) == []
    assert joint_traces(["a", "b", "c"], events, {}) == []


def test_a_state_that_was_not_read_at_a_command_is_the_one_before() -> None:
    events: list[dict[str, Any]] = [
        {"event": "observation", "t": 4.0, "state": [0.5]},
        {"event": "command", "t": 5.0, "command": [1.0], "wanted": [2.0], "state": None},
        {"event": "command", "t": 5.1, "command": [1.1], "state": [1.0]},
    ]
    facts = {"a": {"unit": "rad", "lower": -1, "upper": 3}}
    (trace,) = joint_traces(["a"], events, facts)
    assert trace.states == [0.5, 1.0]
    assert trace.wanted[0] == 2.0
    assert math.isnan(trace.wanted[1])
    assert (trace.unit, trace.limits) == ("rad", (-1.0, 3.0))


def test_phases_and_stops_are_on_the_clock_of_the_first_command() -> None:
    events = [
        *({"event": "command", "t": 10 + 0.1 * n, "phase": "ramp"} for n in range(3)),
        *({"event": "command", "t": 10.3 + 0.1 * n, "phase": "run"} for n in range(2)),
        {"event": "stop", "t": 10.9, "seconds": 0.4, "rule": "chunk", "problem": "nan"},
    ]
    assert [(p.name, round(p.start, 3), round(p.end, 3)) for p in phases(events, 10.0)] == [
        ("ramp", 0.0, 0.2),
        ("run", 0.2, 0.4),
    ]
    (stop,) = stops(events, 10.0)
    assert (round(stop.at, 3), stop.name, stop.text) == (0.5, "chunk", "nan")


def test_a_record_that_was_cut_short_is_counted_from_what_there_is(complete: Path) -> None:
    root = complete.parent / "cut"
    folder = root / "inference" / "001-lift"
    folder.mkdir(parents=True)
    whole = (complete / "inference" / "001-lift" / "trace.jsonl").read_text()
    (folder / "trace.jsonl").write_text(whole[: len(whole) // 2])
    (episode,) = read_episodes(Reader(root), root)
    assert episode.outcome == "cut short"
    assert 80 < len(episode.joints[0].times) < 120
    assert episode.problem == "the record ends without an end"
    assert episode.timings["policy"]["count"] == 1


def test_a_damaged_bag_is_named_and_hurts_nothing_else(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    (tmp_path / "001-x").mkdir()
    (tmp_path / "001-x" / "001-x.mcap").write_bytes(b"not a bag")
    reader = Reader(tmp_path)
    (episode,) = read_episodes(reader, tmp_path)
    assert (episode.name, episode.joints) == ("001-x", [])
    assert reader.problems == ["001-x/001-x.mcap: this is no MCAP file"]


def test_small_helpers() -> None:
    assert math.isnan(number("7"))
    assert number(7) == 7.0
    assert clamp_counts(None) == "none"
    assert clamp_counts({"a": {"velocity": 2, "position": 1}, "b": {}}) == (
        "a 3 (velocity, position)"
    )
    assert text_rows([("a", None), ("b", ""), ("c", 0), ("d", [])]) == [("c", "0")]
