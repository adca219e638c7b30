"""``fluxvla data inspect``, ``validate``, ``stats``, ``convert`` and ``finish``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from fluxvla_core.cli.parser import Parser
from fluxvla_core.errors import UsageError

DIR = "a LeRobot dataset: the folder that holds meta/"


class Inspect:
    api = "1.0"
    help = (
        "Print what a dataset holds: version, robot, episodes, cameras, vectors, instructions. "
        "Reads its tables and decodes nothing."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument("dataset", metavar="DIR", help=DIR)
        parser.add_argument("--json", action="store_true", help="print JSON")

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.data.describe import describe, lines

        facts = describe(Path(args.dataset))
        print(json.dumps(facts, indent=1) if args.json else "\n".join(lines(facts)))
        return 0


class Validate:
    api = "1.0"
    help = (
        "Read every row and decode every frame of a dataset; exit code 2 and what is wrong, file "
        "by file, or 0."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument("dataset", metavar="DIR", help=DIR)
        _log_format(parser)

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.data.validate import validate

        with _reporter(args.log_format, sys.stdout) as reporter:
            doubts = validate(Path(args.dataset), reporter)
            warned = f", {len(doubts)} warnings" if doubts else ""
            reporter.info(f"nothing is wrong with {args.dataset}{warned}")
        return 0


class Stats:
    api = "1.0"
    help = (
        "Print exact statistics of a dataset: every vector, and with --pixels every camera. "
        "Quantiles are of the data itself."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument("dataset", metavar="DIR", help=DIR)
        parser.add_argument("--pixels", action="store_true", help="decode and count all frames")
        parser.add_argument("--json", action="store_true", help="print JSON")
        parser.add_argument("--write", action="store_true", help="put them into meta/stats.json")
        _log_format(parser)

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.data.describe import dataset_statistics, table, write_statistics
        from fluxvla_core.data.statistics import as_lists

        # The statistics are what comes out; how far they are is said beside them.
        with _reporter(args.log_format, sys.stderr) as reporter:
            meta, stats = dataset_statistics(Path(args.dataset), args.pixels, reporter)
            if args.write:
                reporter.artifact("statistics", write_statistics(meta, stats))
        if args.json:
            print(json.dumps({key: as_lists(entry) for key, entry in stats.items()}, indent=1))
        else:
            print("\n".join(table(meta, stats)))
        return 0


class Convert:
    api = "1.0"
    help = (
        "Write a dataset of LeRobot v3.0: from one of v2.0 or v2.1, whose video is copied, not "
        "encoded again, or from episodes that were recorded with fluxvla run --record."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument(
            "sources", metavar="DIR", nargs="+", help="an older dataset, or recordings; stay"
        )
        parser.add_argument("out", metavar="OUT", help="the new dataset's folder")
        parser.once(
            "--fps", type=float, metavar="HZ", help="of recordings; default: the robot's rate"
        )
        parser.add_argument(
            "--successes", action="store_true", help="of recordings: those that succeeded, only"
        )
        _log_format(parser)

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.data.convert import convert
        from fluxvla_core.record.to_dataset import recordings_to_dataset

        datasets = [source for source in args.sources if (Path(source) / "meta").is_dir()]
        with _reporter(args.log_format, sys.stdout) as reporter:
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
    api = "1.0"
    help = (
        "Finish recordings that were cut short (kill -9, a full disk), so that ROS tools open "
        "them. FluxVLA itself reads them as they are."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument(
            "recording", metavar="DIR", help="an episode's folder, or several in one"
        )

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.record.finish import finish_recording
        from fluxvla_core.record.recording import find_recordings

        for path in find_recordings(args.recording):
            done = finish_recording(path)
            print(f"{path}: {'finished' if done else 'is whole'}")
        return 0


def _log_format(parser: Parser) -> None:
    parser.once("--log-format", choices=("text", "json"), default="text", help="of the progress")


@contextmanager
def _reporter(log_format: str, stream: TextIO) -> Iterator[Any]:
    from fluxvla_core.cli.reporters import make_reporter

    reporter = make_reporter(log_format, stream)
    try:
        yield reporter
    finally:
        reporter.close()
