"""Write the HTML page: training curves, success rates, recorded episodes."""

from __future__ import annotations

import base64
import json
import math
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from fluxvla_core.errors import RunFailed, UsageError
from fluxvla_core.results import prepare_folder, work_dirs_below, write_text
from fluxvla_report.episode_view import episode_view, milliseconds, total_ms
from fluxvla_report.facts import Episode, Evaluation, Facts, Training, Video
from fluxvla_report.files import text_rows
from fluxvla_report.read import read_facts
from fluxvla_report.svg import (
    Interval,
    Series,
    duration,
    duration_bar,
    interval_chart,
    line_chart,
    short,
)

# Videos are put into the page up to this many bytes in all; the rest is linked to.
EMBEDDED_BYTES = 32_000_000
MOST_VIDEOS = 12
MOST_PROBLEMS = 5
# Episodes that are shown as a whole, the newest ones; all are in the list.
SHOWN_EPISODES = 4


def build_report(work_dir: Path | str, out: Path | str | None = None, title: str = "") -> Path:
    """Write the report of a work dir; what is missing there is said in it.

    Args:
        work_dir: of ``fluxvla run``.
        out: the HTML file; ``<work_dir>/report.html`` by default.
        title: the heading; by default the name of the config.

    Returns:
        The file that was written.

    Raises:
        UsageError: there is no such folder, nothing to show in it, or the page's cannot be
            written in.
        RunFailed: the page cannot be written, as on a full disk.
    """
    folder = Path(work_dir)
    target = Path(out) if out is not None else folder / "report.html"
    if not folder.is_dir():
        raise UsageError("there is no such work dir to report on", where=str(folder))
    facts = read_facts(folder)
    if not (facts.training or facts.evaluations or facts.episodes or facts.stages):
        raise nothing_there(facts)
    prepare_folder(target.parent, "report's folder", "name another file: --out FILE")
    html = render(facts, target.parent, title)
    try:
        write_text(target, html)
    except OSError as error:
        raise RunFailed(f"the report cannot be written: {error}", where=str(target)) from error
    return target


def nothing_there(facts: Facts) -> UsageError:
    """The error for a folder with nothing to show; names work dirs in it."""
    damaged = "; ".join(facts.problems[:MOST_PROBLEMS])
    inside = [str(path) for path in work_dirs_below(facts.work_dir)[:3]]
    return UsageError(
        "nothing to report on: no training, evaluation or episode of fluxvla run is in this folder"
        + (f" ({damaged})" if damaged else ""),
        where=str(facts.work_dir),
        next="; or ".join(f"fluxvla report {shlex.quote(path)}" for path in inside)
        or "name the work dir that a run said at its end",
    )


def render(facts: Facts, folder: Path, title: str = "") -> str:
    """The page as text; videos that are not embedded are linked relative to ``folder``."""
    templates = resources.files("fluxvla_report") / "templates"
    texts = {
        name: (templates / name).read_text(encoding="utf-8")
        for name in ("report.html.jinja", "style.css")
    }
    # Charts are markup made here, from escaped text; everything else is escaped by the template.
    environment = jinja2.Environment(
        loader=jinja2.DictLoader(texts),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["duration"] = duration
    environment.filters["short"] = short
    sources = VideoSources(folder)
    return environment.get_template("report.html.jinja").render(
        style=texts["style.css"],
        title=title or heading(facts),
        facts=facts,
        tiles=tiles(facts),
        curves=[] if facts.training is None else curves(facts.training),
        evaluations=[_evaluation(e, sources) for e in facts.evaluations],
        episodes=[episode_view(e, sources.put) for e in facts.episodes[-SHOWN_EPISODES:]],
        recordings_only=is_recordings_only(facts),
        stages=duration_bar([(s.name, s.seconds) for s in facts.stages], title="Where time went"),
        environment_rows=environment_rows(facts.environment),
        config_text=json.dumps(facts.config.get("config", {}), indent=2),
    )


@dataclass
class VideoSources:
    """The ``src`` of every video: embedded as long as ``room`` (bytes) lasts, then linked."""

    folder: Path
    room: int = EMBEDDED_BYTES
    _known: dict[Path, str] = field(default_factory=dict)

    def put(self, video: Video) -> dict[str, Any]:
        """``src``, ``caption`` and ``success`` of a video."""
        return {"src": self._source(video.path), "caption": video.caption, "success": video.success}

    def _source(self, path: Path) -> str:
        if path not in self._known:
            size = path.stat().st_size
            if size <= self.room:
                self.room -= size
                coded = base64.b64encode(path.read_bytes()).decode("ascii")
                self._known[path] = f"data:video/mp4;base64,{coded}"
            else:
                self._known[path] = Path(os.path.relpath(path, self.folder)).as_posix()
        return self._known[path]


def heading(facts: Facts) -> str:
    """The name of the config that ran, else of the folder."""
    places = facts.config.get("origins") or {}
    files = [str(place).rpartition(":")[0] for place in places.values()]
    name = Path(files[0]).stem if files and files[0] else facts.work_dir.resolve().name
    return name.replace("_", " ")


def tiles(facts: Facts) -> list[dict[str, str]]:
    """The figures at the top: name, figure, detail."""
    cards = []
    for evaluation, group in ((e, g) for e in facts.evaluations for g in e.groups):
        score, does = group.total, "succeeds"
        if evaluation.scored_by_instruction(group):
            score, does = evaluation.obeyed[group.name], "follows the instruction"
        cards.append(
            {
                "name": f"{group.label}: {does}" if does != "succeeds" else f"{group.label} {does}",
                "figure": f"{score.rate:.0%}",
                "detail": f"{score.successes} of {score.episodes} episodes, interval "
                f"{score.low:.0%} to {score.high:.0%}",
            }
        )
    if facts.training is not None:
        cards.append(_training_tile(facts.training))
    if is_recordings_only(facts):
        cards += _episode_tiles(facts.episodes)
    if facts.dataset:
        data = facts.dataset
        cards.append(
            {
                "name": "demonstrations",
                "figure": str(data.get("total_episodes", "?")),
                "detail": f"{data.get('total_frames', '?')} frames, "
                f"{data.get('total_tasks', '?')} instructions, "
                f"LeRobot {data.get('codebase_version', '?')}",
            }
        )
    if facts.stages:
        total = sum(stage.seconds for stage in facts.stages)
        cards.append(
            {
                "name": "total time",
                "figure": duration(total) if total < 60 else f"{total / 60:.0f} min",
                "detail": f"in {len(facts.stages)} stages",
            }
        )
    return cards


def is_recordings_only(facts: Facts) -> bool:
    """Whether this is a folder of recordings: what else a run has is not missing there."""
    return bool(facts.episodes) and facts.training is None and not facts.config


def _episode_tiles(episodes: Sequence[Episode]) -> list[dict[str, str]]:
    judged = [e.success for e in episodes if e.success is not None]
    commands = sum(len(e.joints[0].times) for e in episodes if e.joints)
    clamped = sum(e.clamped for e in episodes)
    stops = sum(len(e.stops) for e in episodes)
    found = [
        {
            "name": "episodes" if len(episodes) > 1 else "episode",
            "figure": str(len(episodes)) if len(episodes) > 1 else episodes[0].outcome,
            "detail": f"{sum(judged)} of {len(judged)} judged ones succeeded"
            if judged
            else "none judged",
        },
        {
            "name": "commands",
            "figure": f"{commands:,}",
            "detail": f"in {duration(sum(e.seconds for e in episodes))}",
        },
        {
            "name": "clamped by a limit",
            "figure": f"{clamped / commands:.0%}" if commands else "–",
            "detail": f"{clamped} commands; {stops} safe stop{'' if stops == 1 else 's'}",
        },
    ]
    totals = [total for e in episodes if (total := total_ms(e)) is not None]
    if totals:
        found.append(
            {
                "name": "observation to command",
                "figure": milliseconds(totals[-1]),
                "detail": "sum of the stages' medians",
            }
        )
    return found


def _training_tile(training: Training) -> dict[str, str]:
    losses = [v for v in training.columns.get("loss", ()) if math.isfinite(v)]
    last = losses[-max(1, len(losses) // 20) :]
    seconds = sum(v for v in training.columns.get("step_time", ()) if math.isfinite(v))
    detail = f"loss {short(sum(last) / len(last))}" if last else "no loss logged"
    if seconds:
        detail += f" after {duration(seconds)}"
    return {"name": "training steps", "figure": f"{training.steps[-1]:,.0f}", "detail": detail}


def _evaluation(evaluation: Evaluation, sources: VideoSources) -> dict[str, Any]:
    rows = []
    for number, group in enumerate(evaluation.groups):
        scores = group.tasks if len(group.tasks) > 1 else [group.total]
        if evaluation.scored_by_instruction(group):
            named = [("follows the instruction", evaluation.obeyed[group.name])]
        else:
            named = [(score.task if len(group.tasks) > 1 else "", score) for score in scores]
        for name, score in named:
            rows.append(
                Interval(
                    name=f"{group.label} · {name}" if name else group.label,
                    note=f"{score.successes} of {score.episodes}",
                    low=score.low,
                    value=score.rate,
                    high=score.high,
                    css=f"s{number % 6}",
                )
            )
    compared_ones = [video for row in compared(evaluation) for video in row]
    alone = [video for video in evaluation.videos if video not in compared_ones]
    return {
        "facts": evaluation,
        "scored_by_instruction": [
            g.name for g in evaluation.groups if evaluation.scored_by_instruction(g)
        ],
        "problems": evaluation.problems[:MOST_PROBLEMS],
        "more_problems": max(0, len(evaluation.problems) - MOST_PROBLEMS),
        "chart": interval_chart(rows, title="Success rates with 95 % intervals"),
        "rows": text_rows(evaluation.details.items()),
        "made": evaluation.made,
        "compared": [[sources.put(v) for v in row] for row in compared(evaluation)],
        "videos": [sources.put(v) for v in alone[:MOST_VIDEOS]],
        "more": max(0, len(alone) - MOST_VIDEOS),
    }


def compared(evaluation: Evaluation) -> list[list[Video]]:
    """Videos side by side: for each task one of each group, if there are several groups."""
    rows = []
    for task in dict.fromkeys(v.task for v in evaluation.videos if v.group):
        here = [v for v in evaluation.videos if v.task == task]
        # The trained policy's is a success if there is one, for the others are shown next to it.
        best = {v.group: v for v in sorted(here, key=lambda v: bool(v.success))}
        row = [best[g.name] for g in evaluation.groups if g.name in best]
        rows += [row] if len(row) > 1 else []
    return rows


def environment_rows(environment: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Name and value of what the environment file states; plugins as distributions."""
    rows: list[tuple[str, Any]] = []
    for name, value in environment.items():
        if name == "format":
            continue
        if isinstance(value, Mapping):
            rows.append((name, ", ".join(f"{key} {text}" for key, text in value.items())))
        elif name == "plugins" and isinstance(value, list):
            known = (row for row in value if isinstance(row, Mapping))
            rows.append((name, ", ".join(sorted({_distribution(row) for row in known}))))
        else:
            rows.append((name, value))
    return text_rows(rows)


def _distribution(row: Mapping[str, Any]) -> str:
    return f"{row.get('distribution')} {row.get('version')}"


CURVES = (
    ("loss", "Loss", True),
    ("val_loss", "Validation loss", True),
    ("lr", "Learning rate", False),
    ("grad_norm", "Gradient norm", True),
    ("samples_per_s", "Samples per second", False),
    ("data_wait", "Share of time spent waiting for data", False),
    ("mfu", "Model FLOPs utilisation", False),
    ("memory_gb", "Memory (GB)", False),
)
OF_DATASET = "loss/"
# Fewer values are said in words: a chart of them would be empty.
LEAST_POINTS = 3
SMOOTHED = ("loss", "grad_norm", "samples_per_s", "data_wait", "mfu")


def curves(training: Training) -> list[dict[str, Any]]:
    """A chart for each column that was logged, noisy ones with their running mean.

    What was measured at some steps only is a line from one of these to the next.
    """
    charts = []
    for name, label, log in _wanted(training):
        values = training.columns[name]
        points = [p for p in zip(training.steps, values, strict=True) if math.isfinite(p[1])]
        if not points:
            continue
        if len(points) < LEAST_POINTS:
            said = ", ".join(f"{value:.4g} at step {step:g}" for step, value in points)
            charts.append({"name": label, "svg": "", "text": said, "smoothed": False})
            continue
        steps = [step for step, _ in points]
        if (name in SMOOTHED or name.startswith(OF_DATASET)) and len(values) > 20:
            lines = [
                Series("each step", training.steps, values, kind="faint"),
                Series("running mean", training.steps, running_mean(values)),
            ]
        elif 2 * len(points) < len(values):
            lines = [Series(label, steps, [value for _, value in points])]
        else:
            lines = [Series(label, training.steps, values)]
        chart = line_chart(lines, x_label="step", title=f"{label} over the steps", log=log)
        charts.append({"name": label, "svg": chart, "text": "", "smoothed": len(lines) > 1})
    return charts


def _wanted(training: Training) -> Iterator[tuple[str, str, bool]]:
    """Columns with their labels, and whether their axis is by decades."""
    for name, label, log in CURVES:
        if name in training.columns:
            yield name, label, log
        if name == "loss":
            for other in training.columns:
                if other.startswith(OF_DATASET):
                    yield other, f"Loss on {other.removeprefix(OF_DATASET)}", True


def running_mean(values: Sequence[float], share: float = 0.03) -> list[float]:
    """Exponential running mean over about ``share`` of all values; skips what is not finite."""
    weight = 2.0 / (1.0 + max(1.0, share * len(values)))
    means: list[float] = []
    mean = math.nan
    for value in values:
        if math.isfinite(value):
            mean = value if math.isnan(mean) else mean + weight * (value - mean)
        means.append(mean)
    return means
