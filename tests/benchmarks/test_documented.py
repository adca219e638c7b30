"""The figures in docs are those of ``benchmarks/results``, as far as they are in tables."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from benchmarks import memory
from benchmarks.rtc import DELAYS, WAYS
from benchmarks.step_loop import MOST_MS, ONE_LAYER, SMALL
from fluxvla_core.config.load import load_config
from fluxvla_core.control.joiners import METHODS

ROOT = Path(__file__).parents[2]


def results(name: str) -> Any:
    return json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text())


def page(name: str) -> str:
    return " ".join((ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8").split())


def rows(name: str, head: str) -> list[list[str]]:
    """The cells of the table whose first line begins with ``head``."""
    text = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
    table = text[text.index(head) :].partition("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table]


SIDES = {
    "the engine, stock images": "engine, stock images",
    "`gymnasium.vector` (asynchronous) around the same scene, stock images": (
        "gymnasium.vector, stock images"
    ),
    "`lerobot-eval`'s rollout, stock images": "lerobot",
    "the engine, cheap images (the default)": "engine",
    "the same scene in a bare loop, cheap images": "bare",
}


def test_evaluations_are_compared_with_what_drew_as_many_images() -> None:
    found = results("evaluation")
    table = rows("evaluation", "| | cameras drawn |")
    assert [SIDES[row[0]] for row in table] == list(SIDES.values())
    for name, cameras, milliseconds in table:
        assert int(cameras) == found["cameras_drawn"][SIDES[name]], name
        assert int(milliseconds) == round(found["cpu_ms_per_step"][SIDES[name]]), name
    text = page("evaluation")
    equal, lerobot = (found[f"times_{name}_by_cpu"] for name in ("gymnasium_vector", "lerobot"))
    assert f"as fast as Gymnasium's vector environment ({equal:.2f} times)" in text
    assert "LeRobot's environment always renders three cameras" in text
    assert f"nearly all of the factor of {lerobot:.1f}" in text


def joined(parts: list[dict[str, Any]], key: str, digits: int) -> str:
    return " / ".join(f"{row[key]:.{digits}f}" for row in parts)


def of_method(part: str, method: str) -> list[dict[str, Any]]:
    found = [
        row for row in results("chunk_joining")[part]["rows"] if row["chunk_joining"] == method
    ]
    assert [row["latency_s"] for row in found] == [0.0, 0.2, 0.4]
    return found


@pytest.mark.parametrize("method", METHODS)
def test_how_smooth_each_joiner_is(method: str) -> None:
    ((_, *said),) = (r for r in rows("control", "| | done after") if r[0] == f"`{method}`")
    trained = of_method("trained", method)
    assert said == [
        joined(trained, "seconds", 1),
        joined(trained, "largest_step_rad", 2),
        joined(trained, "acceleration_rms", 1),
    ]
    table = rows("control", "| latency 0 / 0.2 / 0.4 s |")
    ((_, *said),) = (r for r in table if r[0] == f"`{method}`")
    free, limited = (of_method(p, method) for p in ("wavering", "wavering_with_jerk_limit"))
    assert said == [
        text
        for part in (free, limited)
        for text in (joined(part, "acceleration_rms", 1), joined(part, "jerk_rms", 0))
    ]


def test_for_which_steps_the_loop_costs_nothing_to_speak_of() -> None:
    cases = results("step_loop")["cases"]
    assert all(row["goal_met"] for name, row in cases.items() if name != SMALL)
    assert {"own_ms", "own_cpu_ms", "ratio"} <= set(cases[SMALL])
    text = page("training")
    assert "`step_loop` has to stay within 3 %, which holds for steps of 40 ms and more" in text
    assert f"(the goal there is {MOST_MS})" in text
    (low, high) = map(float, re.findall(r"on the machine: ([\d.]+) to ([\d.]+), where", text)[0])
    assert low <= cases[ONE_LAYER]["own_cpu_ms"] <= high


def test_the_memory_of_each_family_is_the_recorded_one() -> None:
    families = results("memory")["families"]
    assert list(families) == list(memory.FAMILIES)
    said = (ROOT / "docs" / "models.md").read_text(encoding="utf-8")
    assert memory.table(families) in said
    for family in families.values():
        if family["published"] is not None and family["published"] != family["parameters"]:
            assert f"{family['published']:,}" in said


def test_parameters_are_as_many_as_published() -> None:
    """Where the model has fewer, the rest is never read: the plugins' tests of names say what."""
    families = results("memory")["families"]
    for name in ("SmolVLA", "OpenVLA"):
        assert families[name]["parameters"] == families[name]["published"], name
    for file, name in (("pi0-openpi", "PI0"), ("pi05-openpi", "PI0.5")):
        keys = ROOT / "plugins" / "fluxvla-pi" / "tests" / "keys" / f"{file}.json"
        assert json.loads(keys.read_text())["parameters"] == families[name]["published"]
        # The expert embeds no words.
        unread = families[name]["published"] - families[name]["parameters"]
        assert unread == 257152 * 1024


QUICK = ("CompactVLA", "ACT")


@pytest.mark.parametrize(
    "name",
    [
        name if name in QUICK else pytest.param(name, marks=pytest.mark.slow)
        for name in memory.FAMILIES
    ],
)
def test_the_recorded_memory_is_what_the_program_counts(name: str) -> None:
    for package in ("deepspeed", "peft", "transformers"):
        pytest.importorskip(package)
    found = json.loads(json.dumps(memory.of_family(memory.FAMILIES[name])))
    assert found == results("memory")["families"][name]


@pytest.mark.parametrize("way", WAYS)
def test_how_chunks_are_joined_at_each_delay(way: str) -> None:
    found = [row for row in results("rtc")["rows"] if row["chunk_joining"] == way]
    assert tuple(row["delay_s"] for row in found) == DELAYS
    table = rows("control", "| delay 0 / 50 / 100 / 200 / 300 ms |")
    ((_, *said),) = (row for row in table if row[0] == f"`{way}`")
    (episodes,) = {row["episodes"] for row in found}
    assert f"{episodes} episodes per row and delay" in page("control")
    assert min(row["interval"][0] for row in found) > 0.3
    every = results("rtc")["rows"]
    done, tried = (sum(row[key] for row in every) for key in ("successes", "episodes"))
    assert f"succeeds in {done} of {tried} episodes" in page("control")
    assert {row["late"] for row in found} == {0.0}
    assert "No chunk was late" in page("control")
    step = load_config(ROOT / "configs" / "aloha_sim_pi05_tiny.py").tree["runner"]["max_steps"]
    assert results("rtc")["step"] == step
    assert f"after {step} training steps" in page("control")
    assert said == [
        joined(found, "successes", 0),
        joined(found, "gap_rad", 2),
        joined(found, "largest_step_rad", 2),
        joined(found, "acceleration_rms", 1),
        joined(found, "jerk_rms", 0),
    ]
