"""Commands for trained policies: ``fluxvla eval compare`` and ``fluxvla export``."""

from __future__ import annotations

import argparse

from fluxvla_core.atomic import json_text
from fluxvla_core.cli.parser import Parser
from fluxvla_core.cli.terminal import say


class Compare:
    api = "1.0"
    help = (
        "Compare two evaluations of the same episodes, pair by pair: an exact McNemar test. Exit "
        "code 2 if they are not of the same tasks and seeds."
    )

    def add_arguments(self, parser: Parser) -> None:
        place = "a work dir, its eval folder, or a checkpoint that was evaluated there"
        parser.add_argument("a", metavar="A", help=place)
        parser.add_argument("b", metavar="B", help="the same; may be A, with another group")
        parser.once("--group-a", default="policy", metavar="NAME", help="default policy")
        parser.once("--group-b", default="policy", metavar="NAME", help="default policy")
        parser.add_argument(
            "--common", action="store_true", help="leave out episodes that only one side has"
        )
        parser.add_argument("--json", action="store_true", help="print JSON")

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.evaluation.compare import compare, describe, read

        found = compare(read(args.a, args.group_a), read(args.b, args.group_b), args.common)
        say(json_text(found, indent=1) if args.json else "\n".join(describe(found)))
        return 0


class Export:
    api = "1.0"
    help = (
        "Export a checkpoint for inference into a new folder: all weights in one safetensors "
        "file, adapters merged, with config, statistics, robot and processors."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument(
            "checkpoint",
            metavar="CHECKPOINT",
            help="a checkpoint's folder, or a work dir for its newest one",
        )
        parser.add_argument("folder", metavar="DIR", help="the folder to make")

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.training.export import export

        path = export(args.checkpoint, args.folder)
        size = (path / "model.safetensors").stat().st_size
        say(f"{path}: model.safetensors of {size / 1e6:.1f} MB and what it needs to act")
        return 0
