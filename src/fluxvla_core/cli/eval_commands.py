"""``fluxvla eval compare``."""

from __future__ import annotations

import argparse
import json

from fluxvla_core.cli.parser import Parser


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
        from fluxvla_core.evaluate.comparing import compare, describe, read

        found = compare(read(args.a, args.group_a), read(args.b, args.group_b), args.common)
        print(json.dumps(found, indent=1) if args.json else "\n".join(describe(found)))
        return 0
