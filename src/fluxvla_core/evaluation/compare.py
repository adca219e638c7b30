"""Compare two evaluations of the same episodes: is the difference statistically significant?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluxvla_core.errors import UsageError
from fluxvla_core.evaluation.episodes import DONE, FORMAT, FORMER, complete_lines, read_log
from fluxvla_core.evaluation.results_file import all_of, flat
from fluxvla_core.evaluation.success_rates import mcnemar_test, rate, verdict

NAMED = 5
"""How many episodes a message names."""


@dataclass(frozen=True)
class Evaluated:
    """One side of a comparison: the finished episodes of a group.

    Args:
        folder: the folder of its results.
        group: which of its groups.
        about: what was evaluated, from the evaluation log's first line.
        records: finished episodes.
    """

    folder: Path
    group: str
    about: Mapping[str, Any]
    records: Sequence[Mapping[str, Any]]


def read(place: str | Path, group: str = "policy") -> Evaluated:
    """The episodes of a group.

    Args:
        place: folder with ``episodes.jsonl``; a work dir that holds it in ``eval``; or a checkpoint
            in such a work dir, which must be the one that was evaluated.

    Raises:
        UsageError: there is no such evaluation, or the group has no finished episode in it.
    """
    folder, checkpoint = _folder(Path(place))
    found: list[dict[str, Any]] = []
    about: dict[str, Any] | None = None
    for path in _logs(folder):
        records = complete_lines(read_log(path))
        if not records or records[0].get("format") not in (FORMAT, FORMER):
            continue
        stated = records[0].get("evaluation")
        if not isinstance(stated, dict) or (about is not None and stated != about):
            continue  # parts of an evaluation before
        about = stated
        found += [record for record in records if "format" not in record]
    if about is None:
        raise UsageError(
            "there is no evaluation",
            where=str(place),
            cause="it has no episodes.jsonl, nor a folder eval with one",
            next="evaluate first: fluxvla run --config … --section eval --work-dir DIR",
        )
    if checkpoint is not None and about.get("checkpoint") != _manifest_hash(checkpoint):
        raise UsageError(
            f"the evaluation in {folder} is of another checkpoint",
            where=str(checkpoint),
            next="evaluate this one: --set <section>.ckpt_path=… --work-dir OTHER",
        )
    done = [r for r in found if r.get("status") == DONE and r["group"] == group]
    if not done:
        groups = sorted({r["group"] for r in found if r.get("status") == DONE})
        raise UsageError(
            f"no finished episode of group {group!r}; there are {', '.join(groups) or 'none'}",
            where=str(folder),
        )
    unique = {(r["task"], r["seed"]): r for r in done}
    return Evaluated(folder, group, about, list(unique.values()))


def compare(a: Evaluated, b: Evaluated, common: bool = False) -> dict[str, Any]:
    """The exact McNemar test over all tasks and for each, as JSON values.

    Args:
        common: leave out episodes that only one side has.

    Returns:
        ``all`` and ``tasks`` by name: ``a``, ``b`` (success rates with their intervals) and what
        ``Comparison.to_dict`` has; ``differences``: what else was not the same.

    Raises:
        UsageError: the sides' episodes are not the same (``common`` allows it), or none is.
    """
    left, right = _by_episode(a), _by_episode(b)
    lone = sorted(left.keys() ^ right.keys())
    if lone and (not common or not left.keys() & right.keys()):
        shown = ", ".join(f"{task}/{seed}" for task, seed in lone[:NAMED])
        more = f" and {len(lone) - NAMED} more" if len(lone) > NAMED else ""
        next_step = "evaluate both with the same tasks, seed and number of episodes"
        if left.keys() & right.keys():
            next_step += ", or compare what they share: --common"
        raise UsageError(
            f"the two evaluations are not of the same episodes: only one has {shown}{more}",
            cause=f"{a.folder} has {len(left)} finished episodes, {b.folder} {len(right)}, "
            f"{len(left.keys() & right.keys())} of them the same",
            next=next_step,
        )
    shared = left.keys() & right.keys()
    tasks = dict.fromkeys(r["task"] for r in a.records if (r["task"], r["seed"]) in shared)
    return {
        "a": {"folder": str(a.folder), "group": a.group, "checkpoint": a.about.get("checkpoint")},
        "b": {"folder": str(b.folder), "group": b.group, "checkpoint": b.about.get("checkpoint")},
        "all": _side_by_side([left[k] for k in shared], [right[k] for k in shared]),
        "tasks": {
            task: _side_by_side(
                [left[k] for k in shared if k[0] == task],
                [right[k] for k in shared if k[0] == task],
            )
            for task in tasks
        },
        "unpaired": len(lone),
        "differences": differences(a.about, b.about),
    }


def differences(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[str]:
    """Settings that differ, apart from policy and checkpoint: episodes may not be comparable."""
    one, two = flat(a), flat(b)
    names = [n for n in dict.fromkeys([*one, *two]) if not n.startswith(("policy", "checkpoint"))]
    return [f"{n}: {one.get(n)} / {two.get(n)}" for n in names if one.get(n) != two.get(n)]


def describe(comparison: Mapping[str, Any]) -> list[str]:
    """Lines for people."""
    lines = [f"A: {comparison['a']['folder']} ({comparison['a']['group']})"]
    lines += [f"B: {comparison['b']['folder']} ({comparison['b']['group']})"]
    lines += [f"not the same in both: {line}" for line in comparison["differences"]]
    rows = dict(comparison["tasks"])
    if len(rows) != 1:
        rows[all_of(len(comparison["tasks"]))] = comparison["all"]
    for name, row in rows.items():
        sides = "  ".join(
            f"{side.upper()} {row[side]['successes']}/{row[side]['episodes']} "
            f"({row[side]['low']:.0%} to {row[side]['high']:.0%})"
            for side in ("a", "b")
        )
        lines.append(
            f"{name}: {sides}  A alone {row['only_a']}, B alone {row['only_b']}, "
            f"p = {row['p_different']:.2g}"
        )
    if comparison["unpaired"]:
        lines.append(f"{comparison['unpaired']} episodes that only one side has were left out")
    p = comparison["all"]["p_different"]
    conclusion = verdict(comparison["all"])
    lines.append(f"exact McNemar test, two-sided, all episodes: p = {p:.2g}, {conclusion}")
    return lines


def _side_by_side(a: list[Mapping[str, Any]], b: list[Mapping[str, Any]]) -> dict[str, Any]:
    return {
        "a": rate(sum(bool(r["success"]) for r in a), len(a)),
        "b": rate(sum(bool(r["success"]) for r in b), len(b)),
        **mcnemar_test(a, b).to_dict(),
    }


def _by_episode(side: Evaluated) -> dict[tuple[str, int], Mapping[str, Any]]:
    return {(r["task"], r["seed"]): r for r in side.records}


def _folder(place: Path) -> tuple[Path, Path | None]:
    """The folder of the evaluation logs, and the checkpoint if one was named."""
    if (place / "manifest.json").is_file():
        return place.parent.parent / "eval", place
    if place.is_file():
        return place.parent, None
    return (place, None) if _logs(place) else (place / "eval", None)


def _logs(folder: Path) -> list[Path]:
    """The newest first: parts of a job that was run in other parts may be there, too."""
    found = [*folder.glob("episodes.jsonl"), *folder.glob("episodes-*-of-*.jsonl")]
    return sorted(found, key=lambda path: path.stat().st_mtime_ns, reverse=True)


def _manifest_hash(checkpoint: Path) -> str:
    from fluxvla_core.checkpoints.manifest import NAME, hash_file

    return hash_file(checkpoint / NAME)
