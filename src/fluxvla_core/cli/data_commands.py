"""``fluxvla data``: ``inspect``, ``validate``, ``stats``, ``convert``, ``finish``, ``collect``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from fluxvla_core.cli.parser import Parser, add_json, add_log_format, add_plugin_files, positive
from fluxvla_core.cli.terminal import say
from fluxvla_core.errors import ConfigError, UsageError

if TYPE_CHECKING:
    from fluxvla_core.cli.reporters import RunReporter
    from fluxvla_core.evaluation.collect import Collection


class Inspect:
    help = (
        "Print what a dataset holds: version, robot, episodes, cameras, vectors, instructions. "
        "Reads its tables and decodes nothing."
    )

    def add_arguments(self, parser: Parser) -> None:
        _add_dataset(parser)
        add_json(parser)

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.data.inspection import describe, format_description

        facts = describe(Path(args.dataset))
        say(json.dumps(facts, indent=1) if args.json else "\n".join(format_description(facts)))
        return 0


class Validate:
    help = (
        "Read every row and decode every frame of a dataset; exit code 2 and what is wrong, file "
        "by file, or 0."
    )

    def add_arguments(self, parser: Parser) -> None:
        _add_dataset(parser)
        add_log_format(parser)

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.data.inspection import validate

        with _reporter(args.log_format) as reporter:
            warnings = validate(Path(args.dataset), reporter)
            warned = f", {len(warnings)} warnings" if warnings else ""
            reporter.info(f"nothing is wrong with {args.dataset}{warned}")
        return 0


class Stats:
    help = (
        "Print exact statistics of a dataset: every vector, and with --pixels every camera. "
        "Quantiles are of the data itself."
    )

    def add_arguments(self, parser: Parser) -> None:
        _add_dataset(parser)
        parser.add_argument("--pixels", action="store_true", help="decode and count all frames")
        add_json(parser)
        parser.add_argument("--write", action="store_true", help="put them into meta/stats.json")
        add_log_format(parser)

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.data.inspection import (
            dataset_statistics,
            format_statistics,
            write_statistics,
        )
        from fluxvla_core.data.statistics import as_lists

        # stdout is for the statistics alone.
        with _reporter(args.log_format, sys.stderr) as reporter:
            meta, stats = dataset_statistics(Path(args.dataset), args.pixels, reporter)
            if args.write:
                reporter.artifact("statistics", write_statistics(meta, stats))
        if args.json:
            say(json.dumps({key: as_lists(entry) for key, entry in stats.items()}, indent=1))
        else:
            say("\n".join(format_statistics(meta, stats)))
        return 0


class Convert:
    help = (
        "Write a dataset of LeRobot v3.0: from one of v2.0 or v2.1, whose video is copied, not "
        "encoded again, or from episodes that were recorded with fluxvla run --record."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument(
            "sources",
            metavar="DIR",
            nargs="+",
            help="an older dataset, or recordings; they are not changed",
        )
        parser.add_argument("out", metavar="OUT", help="the new dataset's folder")
        parser.once(
            "--fps",
            type=float,
            metavar="HZ",
            help="frame rate for recordings (default: the robot's rate)",
        )
        parser.add_argument(
            "--successes", action="store_true", help="only recordings that succeeded"
        )
        add_log_format(parser)

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.data.convert import convert
        from fluxvla_core.robot.recording.to_dataset import recordings_to_dataset

        datasets = [source for source in args.sources if (Path(source) / "meta").is_dir()]
        with _reporter(args.log_format) as reporter:
            if not datasets:
                found = recordings_to_dataset(
                    args.sources, args.out, args.fps, args.successes, reporter
                )
            elif len(args.sources) > 1 or args.fps is not None or args.successes:
                raise UsageError(
                    f"{datasets[0]} is a dataset: one is converted, alone, as it is",
                    next="fluxvla data convert DIR OUT",
                )
            else:
                found = convert(datasets[0], args.out, reporter)
            reporter.artifact("dataset", found)
        return 0


class Finish:
    help = (
        "Finish recordings that were cut short (kill -9, a full disk), so that ROS tools open "
        "them. FluxVLA itself reads them as they are."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument(
            "recording", metavar="DIR", help="an episode's folder, or several in one"
        )

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.robot.recording.recorded import find_recordings, finish_recording

        for path in find_recordings(args.recording):
            done = finish_recording(path)
            say(f"{path}: {'finished' if done else 'is complete'}")
        return 0


def _add_dataset(parser: Parser) -> None:
    parser.add_argument(
        "dataset", metavar="DIR", help="a LeRobot dataset: the folder that holds meta/"
    )


@contextmanager
def _reporter(
    log_format: str, stream: TextIO | None = None, heartbeat: bool = False
) -> Iterator[RunReporter]:
    from fluxvla_core.cli.choose_reporter import make_reporter
    from fluxvla_core.cli.reporters import KeepAliveReporter

    made = make_reporter(log_format, stream)
    reporter = KeepAliveReporter(made) if heartbeat else made
    try:
        yield reporter
    finally:
        reporter.close()


_SIDES = {"env": "environment", "policy": "policy"}


class Collect:
    help = (
        "Record demonstrations of a policy in an environment, the environment's scripted expert by "
        "default, as a LeRobot v3.0 dataset with videos."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.once("--env", required=True, metavar="TYPE", help="one of fluxvla.environments")
        parser.once(
            "--policy", default="expert", metavar="TYPE", help="one of fluxvla.policies, or expert"
        )
        parser.once(
            "--episodes", type=positive, required=True, metavar="N", help="number of episodes"
        )
        parser.once("--out", required=True, metavar="DIR", help="the dataset to make")
        parser.once("--tasks", nargs="+", metavar="NAME", help="tasks to record (default: all)")
        parser.once(
            "--seed", type=int, default=10_000, help="seed of the first episode (default 10000)"
        )
        parser.once("--cameras", nargs="+", metavar="NAME", help="cameras to record (default: all)")
        for side in ("height", "width"):
            about = f"{side} of the images in pixels (default: the camera's)"
            parser.once(f"--{side}", type=positive, help=about)
        parser.once(
            "--workers", type=positive, default=2, metavar="N", help="worker processes (default 2)"
        )
        parser.add_argument(
            "--resume", action="store_true", help="continue an interrupted collection"
        )
        parser.add_argument(
            "--failures", action="store_true", help="also keep episodes that failed"
        )
        parser.add_argument(
            "--set",
            dest="arguments",
            action="append",
            default=[],
            metavar="KEY=VALUE",
            help="an argument: env.NAME=VALUE or policy.NAME=VALUE (a TOML value); repeatable",
        )
        add_plugin_files(parser)
        add_log_format(parser)

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.config.overrides import complete_hints
        from fluxvla_core.evaluation.collect import Collection
        from fluxvla_core.plugins.registry import load_plugin_files

        load_plugin_files(args.plugin_files)
        tables = arguments(args.env, args.policy, args.arguments)
        collection = Collection(
            environment=tables["environment"],
            policy=tables["policy"],
            episodes=args.episodes,
            tasks=None if args.tasks is None else tuple(args.tasks),
            seed=args.seed,
            cameras=None if args.cameras is None else tuple(args.cameras),
            height=args.height,
            width=args.width,
            failures=args.failures,
        )
        named = {side: tables[table] for side, table in _SIDES.items()}
        with complete_hints(named):
            collect_demonstrations(collection, args)
        return 0


def collect_demonstrations(collection: Collection, args: argparse.Namespace) -> None:
    """Collect demonstrations, with progress; ``args``: out, workers, resume, log_format."""
    from fluxvla_core.evaluation.collect import collect

    with _reporter(args.log_format, heartbeat=True) as reporter:
        reporter.info(f"collecting {collection.episodes} demonstrations into {Path(args.out)}")
        try:
            results = collect(args.out, collection, args.workers, args.resume, reporter)
        except KeyboardInterrupt as error:
            raise KeyboardInterrupt(
                "finished episodes are kept\n  next: run the same command again with --resume"
            ) from error
        again = f", {results['retried']} tried again" if results["retried"] else ""
        reporter.info(
            f"{results['episodes']} episodes, {results['frames']} new frames{again} in "
            f"{results['seconds']:.0f} s: {results['frames_per_s']:.1f} frames/s"
        )


def arguments(env: str, policy: str, settings: Sequence[str]) -> dict[str, Any]:
    """The tables ``environment`` and ``policy``, checked against the classes' constructors.

    Args:
        settings: ``env.NAME=VALUE`` and ``policy.NAME=VALUE``.

    Raises:
        UsageError: a setting is neither.
        ConfigError: a class takes no such argument, or is not there.
    """
    from fluxvla_core.config.check import examine
    from fluxvla_core.config.overrides import parse_value
    from fluxvla_core.config.tree import Config
    from fluxvla_core.evaluation.policies import EXPERT, resolve_policy

    tables: dict[str, Any] = {"environment": {"type": env}, "policy": {"type": policy}}
    origins = {"environment": f"--env {env}", "policy": f"--policy {policy}"}
    for text in settings:
        key, equals, value = text.partition("=")
        side, dot, name = key.strip().partition(".")
        if side not in _SIDES or not (dot and equals and name):
            raise UsageError(
                f"--set {text}: it is env.NAME=VALUE or policy.NAME=VALUE",
                next="fluxvla data collect --help",
            )
        tables[_SIDES[side]][name] = parse_value(value.strip())
        origins[f"{_SIDES[side]}.{name}"] = f"--set {text}"
    environment = None
    if policy == EXPERT:  # the environment's class names it
        from fluxvla_core.plugins.registry import ENVIRONMENTS

        environment = ENVIRONMENTS.get(env)
    named = resolve_policy(policy, environment)
    if isinstance(named, Mapping):
        tables["policy"] |= named
    checked = examine(Config(tables, origins, "fluxvla data collect"))
    if checked.problems:
        raise ConfigError.from_problems(checked.problems)
    return tables
