"""Charts are well-formed SVG that shows what it was given."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

from fluxvla_core.report.svg import (
    Interval,
    Series,
    duration_bar,
    interval_chart,
    line_chart,
    thinned,
)


def texts(svg: str) -> list[str]:
    return [e.text or "" for e in ET.fromstring(svg).iter("text")]


def numbers(path: str) -> list[list[tuple[float, float]]]:
    strokes = [stroke for stroke in path.split("M") if stroke]
    return [[tuple(map(float, p.split())) for p in s.split("L")] for s in strokes]  # type: ignore[misc]


def test_a_line_runs_from_corner_to_corner() -> None:
    svg = line_chart([Series("loss", [0, 100], [0, 10])], x_label="step", title="Loss")
    root = ET.fromstring(svg)
    (path,) = root.iter("path")
    ((start, end),) = numbers(path.get("d") or "")
    assert start == (48.0, 176.0)
    assert end == (508.0, 10.0)
    assert root.find("title").text == "Loss"  # type: ignore[union-attr]
    assert {"step", "0", "100", "10"} <= set(texts(svg))


def test_a_value_that_is_not_finite_interrupts_the_line() -> None:
    ys = [1.0, 2.0, math.nan, 2.0, 1.0]
    svg = line_chart([Series("loss", range(5), ys)], x_label="step", title="Loss")
    (path,) = ET.fromstring(svg).iter("path")
    assert [len(stroke) for stroke in numbers(path.get("d") or "")] == [2, 2]


def test_dots_and_names_that_need_escaping() -> None:
    svg = line_chart(
        [Series("a<b", [1, 2], [3, 4], css="bad", kind="dots")], x_label="a<b", title='"<&'
    )
    root = ET.fromstring(svg)
    assert len(list(root.iter("circle"))) == 2
    assert "a<b" in texts(svg)


def test_a_chart_of_nothing_is_still_a_chart() -> None:
    assert "0.5" in texts(line_chart([], x_label="step", title="Loss", log=True))


def test_intervals() -> None:
    svg = interval_chart([Interval("trained", "44 of 50", 0.76, 0.88, 0.94)], title="Success")
    assert {"trained", "44 of 50", "0%", "100%"} <= set(texts(svg))
    band = next(e for e in ET.fromstring(svg).iter("line") if e.get("class") == "band")
    assert float(band.get("x1") or 0) < float(band.get("x2") or 0)


def test_long_names_do_not_run_into_the_scale() -> None:
    name = "trained policy, on the robot · transfer_cube"
    svg = interval_chart([Interval(name, "", 0.0, 0.0, 0.2)], title="Success")
    band = next(e for e in ET.fromstring(svg).iter("line") if e.get("class") == "band")
    assert float(band.get("x1") or 0) > 7 * len(name)


def test_durations_share_the_bar() -> None:
    svg = duration_bar([("train", 90.0), ("evaluate", 30.0)], title="Time")
    widths = [float(e.get("width") or 0) for e in ET.fromstring(svg).iter("rect")]
    assert widths[0] == 644.0
    assert widths[2] == 214.0
    assert texts(svg) == ["train · 1 min 30 s", "evaluate · 30 s"]
    assert "0.0 s" in texts(duration_bar([("none", 0.0)], title="Time"))[0]


def test_thinning_keeps_the_ends_and_every_peak() -> None:
    xs = [float(x) for x in range(10_000)]
    ys = [0.0] * 10_000
    ys[5003], ys[7777] = 9.0, -9.0
    kept = thinned(xs, ys, most=100)
    assert len(kept) <= 104
    assert {0, 5003, 7777, 9999} <= set(kept)
    assert thinned([1.0, 2.0], [1.0, math.nan]) == [0, 1]
    assert thinned(xs, [math.nan] * 10_000, most=10)[0] == 0
