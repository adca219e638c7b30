"""Commands for trained policies: ``eval compare``, ``export`` and ``import-checkpoint``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from fluxvla_core.atomic import json_text
from fluxvla_core.cli.parser import Parser, add_json
from fluxvla_core.cli.reporters import heartbeat
from fluxvla_core.cli.terminal import say
from fluxvla_core.errors import UsageError


class Compare:
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
        add_json(parser)

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.evaluation.compare import compare, describe, read

        with heartbeat(f"comparing {args.a} with {args.b}"):
            found = compare(read(args.a, args.group_a), read(args.b, args.group_b), args.common)
        say(json_text(found, indent=1) if args.json else "\n".join(describe(found)))
        return 0


class Export:
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
        parser.once(
            "--format",
            metavar="NAME",
            help="write it as another project saves one: lerobot, openpi, … (a plugin's format)",
        )

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.training.export import export, export_foreign

        with heartbeat(f"exporting {args.checkpoint}"):
            if args.format is None:
                path = export(args.checkpoint, args.folder)
                size = (path / "model.safetensors").stat().st_size
                about = f"model.safetensors of {size / 1e6:.1f} MB and what it needs to act"
            else:
                path = export_foreign(args.checkpoint, args.folder, args.format)
                about = f"a checkpoint in the format of {args.format}"
        say(f"{path}: {about}")
        return 0


class Import:
    help = (
        "Make a checkpoint of FluxVLA from one of another project (openpi, LeRobot, GR00T, …), by "
        "the format that an installed plugin has for its model family."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument(
            "source",
            metavar="SRC",
            help="the checkpoint's folder, or hf:OWNER/NAME[@REVISION] on the Hugging Face hub",
        )
        parser.add_argument("folder", metavar="OUT", help="the folder to make")
        parser.once("--format", metavar="NAME", help="the project's format (default: detected)")
        parser.once(
            "--tokenizer", metavar="DIR", help="the tokenizer's folder, if the checkpoint has none"
        )
        parser.once(
            "--embodiment",
            metavar="FILE",
            help="the robot: an embodiment.json, or a dataset's or checkpoint's folder with one; "
            "without it, the result can be trained on but drives no robot",
        )
        parser.once(
            "--rate", metavar="HZ", type=float, help="actions a second, if the checkpoint says none"
        )
        parser.add_argument(
            "--camera",
            metavar="THEIRS=OURS",
            action="append",
            default=[],
            help="the robot's name of a camera, or 'none' where the robot has no such camera; may "
            "be repeated",
        )
        parser.once(
            "--robot",
            metavar="NAME",
            help="which one, if the checkpoint knows several: GR00T's embodiment tag, OpenVLA's "
            "unnorm_key, the folder of openpi's statistics",
        )

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.training.export import embodiment_in, import_checkpoint

        if args.rate is not None and not 0 < args.rate < float("inf"):
            raise UsageError(f"--rate {args.rate:g} is not a rate")
        cameras = _cameras(args.camera)
        embodiment = None if args.embodiment is None else embodiment_in(args.embodiment)
        with heartbeat(f"importing {args.source}"):
            path, checkpoint = import_checkpoint(
                args.source,
                args.folder,
                format=args.format,
                tokenizer=args.tokenizer,
                embodiment=embodiment,
                action_rate_hz=args.rate,
                cameras=cameras,
                robot=args.robot,
            )
        name = "no robot" if checkpoint.embodiment is None else checkpoint.embodiment.name
        hz = checkpoint.action_rate_hz
        rate = f"{hz:g} Hz" if hz else "an unknown rate"
        say(
            f"{path}: {checkpoint.model['type']}, {len(checkpoint.tensors)} tensors; cameras "
            f"{', '.join(checkpoint.img_keys) or 'none'}; chunks of {checkpoint.horizon} actions "
            f"at {rate}; {name}"
        )
        for note in checkpoint.notes:
            say(f"note: {note}")
        return 0


def _cameras(options: Sequence[str]) -> dict[str, str | None]:
    """The checkpoint's camera -> the robot's; None for one that the robot lacks."""
    cameras: dict[str, str | None] = {}
    for text in options:
        source, equals, camera = text.partition("=")
        if not (source and equals and camera):
            raise UsageError(f"--camera {text!r} is not THEIRS=OURS")
        if source in cameras:
            raise UsageError(f"--camera {source}=… is given twice")
        cameras[source] = None if camera == "none" else camera
    return cameras
