"""The summary of an episode follows from its events."""

from __future__ import annotations

from fluxvla_core.robot.recording.episode_log import summarise

CLAMP = {"joint": "a", "wanted": 2.0, "given": 1.0, "reason": "velocity"}
EVENTS = [
    {"event": "start", "t": 0.0, "task": "1", "instruction": "wave", "seed": 7, "robot": "Arm",
     "rate_hz": 50.0, "embodiment": {"name": "arm", "joints": [{"name": "a"}]}},
    {"event": "observation", "t": 0.0, "ms": {"receipt": 1.0, "sync": 2.0}},
    {"event": "chunk", "t": 0.1, "ms": {"policy": 30.0}},
    {"event": "command", "t": 0.1, "phase": "ramp", "clamps": [CLAMP], "ms": {"late": None}},
    {"event": "command", "t": 0.2, "phase": "run", "clamps": [CLAMP], "ms": {"late": 0.1}},
]  # fmt: skip


def test_counts_and_timings() -> None:
    end = {"event": "end", "t": 0.3, "outcome": "done", "success": True, "problem": None}
    found = summarise([*EVENTS, {**end, "skipped_ticks": 2, "trips": []}])
    assert (found["outcome"], found["success"], found["problem"]) == ("done", True, None)
    assert (found["steps"], found["chunks"], found["skipped_ticks"]) == (1, 1, 2)
    assert (found["embodiment"], found["joints"], found["robot"]) == ("arm", ["a"], "Arm")
    assert found["clamps"] == {"a": {"velocity": 2}}
    assert list(found["timings"]) == ["receipt", "sync", "policy", "late"]
    assert found["timings"]["late"]["count"] == 1


def test_skipped_ticks_are_read_under_their_former_key() -> None:
    end = {"event": "end", "t": 0.3, "outcome": "done", "skipped_beats": 2}
    assert summarise([*EVENTS, end])["skipped_ticks"] == 2


def test_filters_that_were_late_are_counted_by_name() -> None:
    late = [{"event": "filter", "t": 0.2, "filter": name} for name in ("Slow", "Other", "Slow")]

    assert summarise([*EVENTS, *late])["late_filters"] == {"Slow": 2, "Other": 1}
    assert summarise(EVENTS)["late_filters"] == {}


def test_a_record_without_an_end_was_cut_short() -> None:
    found = summarise(EVENTS)
    assert found["outcome"] == "cut short"
    assert found["problem"] == "the record ends without an end"
    assert summarise([])["joints"] == []
