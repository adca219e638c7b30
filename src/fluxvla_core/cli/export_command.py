"""``fluxvla export``."""

from __future__ import annotations

import argparse

from fluxvla_core.cli.parser import Parser


class Export:
    api = "1.0"
    help = (
        "Write what acts of a checkpoint into a folder of its own: all weights in one safetensors "
        "file, adapters merged, with config, statistics, robot and processors."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument(
            "checkpoint", metavar="CHECKPOINT", help="its folder, or a work dir for its newest one"
        )
        parser.add_argument("folder", metavar="DIR", help="the folder to make")

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.train.export import export

        path = export(args.checkpoint, args.folder)
        size = (path / "model.safetensors").stat().st_size
        print(f"{path}: model.safetensors of {size / 1e6:.1f} MB and what it needs to act")
        return 0
