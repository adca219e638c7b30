"""Charts are well-formed SVG that shows what it was given."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

from fluxvla_report.svg import (
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
    html = interval_chart([Interval("a<b", "44 of 50", 0.76, 0.88, 0.94)], title='"Success"')
    root = ET.fromstring(html)
    assert {"0%", "100%"} <= set(texts(html))
    assert {"a<b", "44 of 50"} <= {span.text for span in root.iter("span")}
    band = next(e for e in root.iter("line") if e.get("class") == "band")
    assert (band.get("x1"), band.get("x2")) == ("76.00%", "94.00%")
    assert root.get("aria-label") == '"Success"'


def test_rows_are_as_wide_as_the_page_and_their_names_are_no_part_of_the_drawing() -> None:
    name = "trained policy, on the robot · transfer_cube"
    root = ET.fromstring(interval_chart([Interval(name, "", 0.0, 0.0, 0.2)], title="Success"))
    drawings = list(root.iter("svg"))
    assert len(drawings) == 2  # the row and the scale
    assert not any(svg.get("viewBox") or svg.get("width") for svg in drawings)
    assert name not in "".join(text for svg in drawings for text in svg.itertext())


def test_durations_share_the_bar() -> None:
    root = ET.fromstring(duration_bar([("train", 90.0), ("evaluate", 30.0)], title="Time"))
    assert [e.get("width") for e in root.iter("rect")] == ["75.00%", "25.00%"]
    said = ["".join(item.itertext()) for item in root.iter("li")]
    assert said == ["train · 1 min 30 s", "evaluate · 30 s"]
    assert "0.0 s" in duration_bar([("none", 0.0)], title="Time")


def test_thinning_keeps_the_ends_and_every_peak() -> None:
    xs = [float(x) for x in range(10_000)]
    ys = [0.0] * 10_000
    ys[5003], ys[7777] = 9.0, -9.0
    kept = thinned(xs, ys, most=100)
    assert len(kept) <= 104
    assert {0, 5003, 7777, 9999} <= set(kept)
    assert thinned([1.0, 2.0], [1.0, math.nan]) == [0, 1]
    assert thinned(xs, [math.nan] * 10_000, most=10)[0] == 0
