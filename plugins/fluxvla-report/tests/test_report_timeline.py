"""The charts of an episode: what happened when, and where its time went."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import replace

from fluxvla_report.episode_view import (
    StageTime,
    budget_chart,
    clamp_css,
    clamp_note,
    episode_view,
    headline,
    legend,
    milliseconds,
    stage_times,
    timeline,
    total_ms,
)
from fluxvla_report.facts import Episode, JointTrace, Moment, Span
from fluxvla_report.svg import Mark, Series, Shade, line_chart


def titles(svg: str) -> list[str]:
    return [e.text or "" for e in ET.fromstring(svg).iter("title")]


def texts(html: str) -> list[str]:
    return [e.text or "" for tag in ("text", "span") for e in ET.fromstring(html).iter(tag)]


def widths(html: str) -> list[float]:
    return [float((e.get("width") or "").rstrip("%")) for e in ET.fromstring(html).iter("rect")]


def test_a_timeline_has_phases_answers_clamps_and_stops() -> None:
    spans = [Span("ramp", 0.0, 1.0), Span("run", 1.0, 4.0)]
    svg = timeline(spans, [1.0, 2.0], [1.5], [Moment(4.0, "chunk", "a < b")], title="when")
    assert {"phase", "2 answers", "1 clamped", "ramp", "run", "0 s", "4 s"} <= set(texts(svg))
    assert "ramp: 1.00 s" in titles(svg)
    assert "chunk: a < b" in titles(svg)
    assert widths(svg) == [25.0, 75.0]


def test_rows_and_legends_name_only_what_is_drawn() -> None:
    assert "answers" not in timeline([Span("run", 0.0, 1.0)], [], [], [], title="when")
    bare = replace(JOINT, states=[math.nan, math.nan], clamped=())
    phases = [Span("run", 0.0, 0.5)]
    assert legend(episode(joints=[bare], phases=phases)) == [("s0", "command")]
    rich = replace(JOINT, wanted=[0.0, 1.0], limits=(-1.0, 1.0))
    more = {"phases": [*phases, Span("hold", 0.5, 1.0)], "stops": [Moment(0.5, "chunk")]}
    assert len(legend(episode(joints=[rich], **more))) == 7


def test_a_budget_is_to_scale() -> None:
    rows = [StageTime("sync", 5.0, 10.0, 20.0, "gathering"), StageTime("send", 1.0, 1.0, 1.0)]
    svg = budget_chart(rows, title="Latency")
    assert widths(svg) == [100.0, 50.0, 25.0, 5.0, 5.0, 5.0]
    assert {"sync", "5.0 ms", "20.0 ms", "median"} <= {t.strip() for t in texts(svg)}
    assert "gathering" in [span.get("title") for span in ET.fromstring(svg).iter("span")]
    budget_chart([StageTime("none", math.nan, math.nan, math.nan)], title="Latency")


def test_milliseconds_have_as_many_digits_as_matter() -> None:
    assert [milliseconds(v) for v in (0.012, 1.234, 123.4)] == ["0.01 ms", "1.2 ms", "123 ms"]
    assert milliseconds(math.nan) == "–"


def test_shades_and_marks_lie_where_they_should_and_not_outside() -> None:
    svg = line_chart(
        [Series("x", [0, 10], [0, 1])],
        x_label="s",
        title="t",
        shades=[Shade("ramp", 0, 5)],
        marks=[Mark(5, "stop"), Mark(20, "later"), Mark(0.5, "limit", vertical=False)],
    )
    assert {"ramp", "stop", "limit"} <= set(titles(svg))
    assert "later" not in titles(svg)
    (shade,) = ET.fromstring(svg).iter("rect")
    assert float(shade.get("width") or 0) == (520 - 48 - 12) / 2


ROW = {"count": 3, "p50_ms": 2.0, "p95_ms": 3.0, "p99_ms": 4.0, "max_ms": 5.0}
JOINT = JointTrace("a", "rad", [0.0, 0.5], [0.0, 1.0], [0.0, 0.9], [(0.5, 1.0)])


def episode(**more: object) -> Episode:
    given = {"joints": [JOINT], "timings": {}, "notes": {"robot": "Arm"}}
    return Episode("001", "wave", "done", True, **{**given, **more})  # type: ignore[arg-type]


def test_stages_are_in_pipeline_order_and_no_time_counts_twice() -> None:
    names = ("late", "send", "policy", "inference", "sync")
    found = stage_times(episode(timings=dict.fromkeys(names, ROW)))
    assert [row.name for row in found] == ["sync", "inference", "send"]
    assert total_ms(episode(timings=dict.fromkeys(names, ROW))) == 6.0
    assert [row.name for row in stage_times(episode(timings={"policy": ROW}))] == ["policy"]
    assert total_ms(episode(timings={"policy": ROW})) is None


def test_the_headline_says_how_it_went() -> None:
    assert headline(episode()) == ("ended: done · 2 commands in 0.5 s · 1 changed by a limit · Arm")
    assert headline(episode(joints=[], notes={})) == "ended: done"


def test_an_episode_without_commands_has_no_charts() -> None:
    view = episode_view(episode(joints=[]), lambda video: {})
    assert (view["timeline"], view["joints"], view["budget"], view["total"]) == ("", [], "", None)


def test_clamps_are_explained_and_red_only_where_something_went_wrong() -> None:
    jaw = JointTrace("jaw", "", [0.0, 0.5], [0, 1], [0, 1], [(0.0, 0.0), (0.5, 1.0)], gripper=True)
    arm = JointTrace("arm", "rad", [0.0, 0.5], [0, 1], [0, 1], [(0.5, 1.0)])
    done = Episode("001", "lift", "done", True, [arm, jaw], {})
    note = clamp_note(done)
    assert "changed 2 of 2 commands (2 jaw, 1 arm)" in note
    assert "Most are a gripper's" in note
    assert "gripper" not in clamp_note(replace(done, joints=[arm]))
    assert clamp_note(replace(done, joints=[replace(arm, clamped=())])) == ""
    assert clamp_css(done) == clamp_css(replace(done, success=None)) == "s3"
    assert clamp_css(replace(done, success=False)) == "bad"
    assert clamp_css(replace(done, stops=[Moment(1.0, "chunk")])) == "bad"
