"""``fluxvla new-plugin``: begin a plugin that builds, passes its tests and runs."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from fluxvla_core.cli.parser import Parser, natural, positive
from fluxvla_core.cli.terminal import say
from fluxvla_core.errors import UsageError

if TYPE_CHECKING:
    from fluxvla_core.cli.scaffold import Kind, Plugin

ROBOT = "operator"
JOINTS, CAMERAS = 7, 2
"""Default sizes of a robot."""
BASE = """(
    Joint.base("base_forward", "m/s", speed=0.5, acceleration=1.0),
    Joint.base("base_turn", "rad/s", speed=1.0, acceleration=2.0),
)"""
"""The joints of a mobile base, in the words of an embodiment."""
DOMAIN = "export ROS_DOMAIN_ID=42 ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST"
"""So that no other robot is commanded."""


class NewPlugin:
    api = "1.0"
    help = (
        "Write the sources of a new plugin into a new folder: a distribution that builds, passes "
        "its tests and runs as it is, with a stand-in for what only you have. Nothing is "
        "downloaded or installed."
    )

    def add_arguments(self, parser: Parser) -> None:
        from fluxvla_core.cli.scaffold import KINDS

        parser.add_argument("name", help="of the distribution; 'fluxvla-' is put before it")
        parser.once("--kind", required=True, metavar="KIND", help=f"one of {', '.join(KINDS)}")
        parser.once("--dir", default=".", metavar="DIR", help="where the new folder is made")
        parser.once("--joints", type=positive, metavar="N", help=f"of a robot (default {JOINTS})")
        parser.once("--cameras", type=natural, metavar="N", help=f"of a robot (default {CAMERAS})")
        parser.add_argument(
            "--mobile-base", action="store_true", help="a robot that drives: two speeds more"
        )
        parser.add_argument(
            "--ros2", action="store_true", help="a robot whose drivers are ROS 2 nodes"
        )

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.cli import scaffold

        kind, plugin = scaffold.kind_of(args.kind), scaffold.plugin_of(args.name)
        options = _options(args)
        kind = scaffold.ROS2 if args.ros2 else kind
        _refuse_taken(plugin, kind)
        folder = Path(args.dir) / plugin.dist
        files = scaffold.render(plugin, kind, options)
        scaffold.write(files, folder)
        todo = [name for name, text in files.items() if "TODO" in text]
        say("\n".join(_next_steps(folder, plugin, kind, len(files), todo)))
        return 0


def _options(args: argparse.Namespace) -> dict[str, str]:
    """Placeholders with what the command line says of a robot.

    Raises:
        UsageError: it says that of something else.
    """
    given = {
        "joints": args.joints is not None,
        "cameras": args.cameras is not None,
        "mobile-base": args.mobile_base,
        "ros2": args.ros2,
    }
    for name, there in given.items():
        if there and args.kind != ROBOT:
            raise UsageError(f"--{name} is for --kind {ROBOT}, and this is a {args.kind}")
    joints = JOINTS if args.joints is None else args.joints
    cameras = CAMERAS if args.cameras is None else args.cameras
    base = BASE if args.mobile_base else "()"
    return {"joints": str(joints), "cameras": str(cameras), "base": base}


def _refuse_taken(plugin: Plugin, kind: Kind) -> None:
    """Raises UsageError where another distribution has the name, or a class of that name."""
    from fluxvla_core.cli.scaffold import class_name
    from fluxvla_core.plugins import first_party
    from fluxvla_core.plugins._metadata import canonical, index

    if plugin.dist == "fluxvla-core" or plugin.dist in first_party.FIRST_PARTY:
        raise UsageError(f"{plugin.dist} is a distribution of FluxVLA itself; choose another name")
    for part in kind.parts:
        name = class_name(plugin, part)
        owner = first_party.owner(part.registry, name)
        found = index().plugins.get((f"fluxvla.{part.registry}", name), ())
        others = [p.dist for p in found if canonical(p.dist) != plugin.dist]
        if owner or others:
            raise UsageError(
                f"{name} is provided by {owner or others[0]} already; choose another name"
            )


def _next_steps(folder: Path, plugin: Plugin, kind: Kind, files: int, todo: list[str]) -> list[str]:
    from string import Template

    from fluxvla_core.cli.scaffold import class_name

    place = shlex.quote(str(folder))
    name = class_name(plugin, kind.parts[0])
    run = Template(kind.run).substitute(short=plugin.short, type=name)
    beside = Template(kind.beside).substitute(package=plugin.package)
    return [
        f"{folder}: {files} files. Next:",
        f"  pip install -e {shlex.quote(f'{folder}[testing]')}",
        f"  python -m pytest {place}",
        *([f"  {DOMAIN}  # here and in another terminal"] if beside else []),
        *([f"  {beside}  # there: it stands in for the robot"] if beside else []),
        f"  cd {place} && {run}",
        f"What only you can fill in is marked TODO: {', '.join(todo)}",
    ]
