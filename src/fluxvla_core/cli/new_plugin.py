"""``fluxvla new-plugin``: begin a plugin that builds, passes its tests and runs.

A template of ``fluxvla_core/templates`` is a file whose name ends with ``.tmpl``, with the
placeholders of ``string.Template``. Its path below the folder of its kind is that of the file that
it becomes: ``PACKAGE`` stands for the import package, ``NAME`` for the plugin's short name, and a
leading ``dot-`` for a dot.
"""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from string import Template

from fluxvla_core.cli.parser import Parser, natural, positive
from fluxvla_core.cli.terminal import say
from fluxvla_core.errors import UsageError, nearest

ROBOT = "operator"
JOINTS, CAMERAS = 7, 2
"""Default sizes of a robot."""
BASE = """(
    Joint.base("base_forward", "m/s", speed=0.5, acceleration=1.0),
    Joint.base("base_turn", "rad/s", speed=1.0, acceleration=2.0),
)"""
"""The joints of a mobile base, as source text."""
DOMAIN = "export ROS_DOMAIN_ID=42 ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST"
"""So that no other robot is commanded."""


TEMPLATES = Path(__file__).resolve().parents[1] / "templates"
PREFIX = "fluxvla-"
SUFFIX = ".tmpl"
COMMON = "common"
# PEP 508's rule for names.
_NAME = re.compile(r"[A-Za-z0-9]|[A-Za-z0-9][A-Za-z0-9._-]*[A-Za-z0-9]")
_LONGEST = 32
"""Characters of a name: paths and class names stay readable."""


class NewPlugin:
    help = (
        "Write the sources of a new plugin into a new folder: a distribution that builds, passes "
        "its tests and runs as it is, with a stand-in for what only you have. Nothing is "
        "downloaded or installed."
    )

    def add_arguments(self, parser: Parser) -> None:
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
        kind, plugin = kind_of(args.kind), plugin_of(args.name)
        options = _options(args)
        kind = ROS2 if args.ros2 else kind
        _refuse_taken(plugin, kind)
        folder = Path(args.dir) / plugin.dist
        files = render(plugin, kind, options)
        write(files, folder)
        todo = [name for name, text in files.items() if "TODO" in text]
        say("\n".join(_next_steps(folder, plugin, kind, len(files), todo)))
        return 0


def _options(args: argparse.Namespace) -> dict[str, str]:
    """Values of the placeholders that describe a robot.

    Raises:
        UsageError: they are given for another kind.
    """
    for name in ("joints", "cameras", "mobile_base", "ros2"):
        if getattr(args, name) not in (None, False) and args.kind != ROBOT:
            flag = name.replace("_", "-")
            raise UsageError(f"--{flag} is for --kind {ROBOT}, and this is a {args.kind}")
    joints = JOINTS if args.joints is None else args.joints
    cameras = CAMERAS if args.cameras is None else args.cameras
    base = BASE if args.mobile_base else "()"
    return {"joints": str(joints), "cameras": str(cameras), "base": base}


def _refuse_taken(plugin: Plugin, kind: Kind) -> None:
    """Raises UsageError where another distribution has the name, or a class of that name."""
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


@dataclass(frozen=True)
class Part:
    """A class of a rendered plugin: its registry, what its name ends with, and its module."""

    registry: str
    suffix: str
    module: str


@dataclass(frozen=True)
class Kind:
    """The templates and settings of one kind of plugin.

    Args:
        parts: the classes that it registers; the first is the main one.
        folders: of templates, after ``common``; a later one replaces files of an earlier one.
        about: description, for its metadata and its package's docstring.
        extras: extras of the core that it needs.
        run: the command that runs it, in the folder of the distribution.
        beside: the command that has to run meanwhile, in another terminal.
        ci: further packages that its CI installs.
    """

    parts: tuple[Part, ...]
    folders: tuple[str, ...]
    about: str
    extras: tuple[str, ...]
    run: str
    beside: str = ""
    ci: str = ""


RUN = "fluxvla run --config configs/${short}.toml"
RUN_STAND_IN = f"{RUN} --plugin configs/stand_in.py"


def _in_training(name: str, about: str, part: Part) -> Kind:
    """The kind of a class that is run by training a small stand-in model."""
    return Kind((part,), ("training", name), f"{about} for FluxVLA", ("train",), RUN_STAND_IN)


KINDS: Mapping[str, Kind] = {
    "operator": Kind(
        (
            Part("operators", "Operator", "operator"),
            Part("runners", "InferenceRunner", "runner"),
            Part("policies", "DemoPolicy", "policy"),
        ),
        ("operator",),
        "A robot for FluxVLA",
        ("data",),  # an episode leaves a video of each camera
        f"{RUN} --task 1",
    ),
    "policy": Kind(
        (Part("policies", "Policy", "policy"),),
        ("policy",),
        "A policy for FluxVLA",
        (),
        RUN_STAND_IN,
    ),
    "model": _in_training("model", "A model", Part("vlas", "VLA", "model")),
    "environment": Kind(
        (Part("environments", "Environment", "environment"), Part("policies", "Expert", "expert")),
        ("environment",),
        "An environment for FluxVLA",
        (),
        RUN,
    ),
    "dataset": _in_training("dataset", "A dataset", Part("datasets", "Dataset", "dataset")),
    "transform": _in_training(
        "transform", "A transform", Part("transforms", "Transform", "transform")
    ),
    "hook": _in_training("hook", "A hook", Part("hooks", "Hook", "hook")),
    "metric": _in_training("metric", "A metric", Part("metrics", "Metric", "metric")),
    "command": Kind(
        (Part("commands", "Command", "command"),),
        ("command",),
        "A command for FluxVLA",
        (),
        "fluxvla ${type}",
    ),
    "train-runner": _in_training(
        "train-runner", "A training strategy", Part("runners", "TrainRunner", "runner")
    ),
}
ROS2 = replace(
    KINDS["operator"],
    folders=("operator", "operator-ros2"),
    about="A robot on ROS 2 for FluxVLA",
    beside="python -m ${package}.driver",
    ci="'fluxvla-core[ros2]'",
)
"""The kind ``operator`` for a robot whose drivers are ROS 2 nodes."""


@dataclass(frozen=True)
class Plugin:
    """The names of a plugin that is to be rendered.

    Args:
        dist: the distribution, ``fluxvla-my-arm``.
        package: the import package, ``fluxvla_my_arm``.
        short: the name without its prefix, ``my_arm``.
        stem: what its classes' names begin with, ``MyArm``.
    """

    dist: str
    package: str
    short: str
    stem: str


def plugin_of(name: str) -> Plugin:
    """The names that follow from ``name``, with the prefix ``fluxvla-`` if it has none.

    Raises:
        UsageError: it cannot be the name of a distribution and of classes.
    """
    if not _NAME.fullmatch(name):
        raise UsageError(
            f"{name!r} is no name for a distribution: letters, digits, '-', '_' and '.', with a "
            "letter or a digit at both ends"
        )
    dist = re.sub(r"[-_.]+", "-", name).lower()
    dist = dist if dist.startswith(PREFIX) else PREFIX + dist
    words = dist.removeprefix(PREFIX).split("-")
    if not words[0][:1].isalpha():
        raise UsageError(
            f"{name!r} gives classes no name: what follows {PREFIX!r} must begin with a letter"
        )
    if len(dist) > _LONGEST:
        raise UsageError(f"{name!r} is longer than {_LONGEST} characters")
    stem = "".join(word[:1].upper() + word[1:] for word in words)
    return Plugin(dist, dist.replace("-", "_"), "_".join(words), stem)


def kind_of(name: str) -> Kind:
    """The kind called ``name``.

    Raises:
        UsageError: there is none.
    """
    if name not in KINDS:
        near = nearest(name, KINDS)
        hint = f"did you mean {near!r}?" if near else f"there are {', '.join(KINDS)}"
        raise UsageError(f"there is no kind {name!r} of plugin; {hint}")
    return KINDS[name]


def class_name(plugin: Plugin, part: Part) -> str:
    """What the class of ``part`` is called: ``MyArmOperator``; no word is there twice."""
    if part.registry == "commands":
        return plugin.short.replace("_", "-")
    return plugin.stem.removesuffix(part.suffix) + part.suffix


def render(plugin: Plugin, kind: Kind, options: Mapping[str, str]) -> dict[str, str]:
    """Path in the distribution's folder -> text, of every file.

    Args:
        options: placeholders that the command line gives values to.
    """
    values = {**_values(plugin, kind), **options}
    values["run"] = Template(kind.run).substitute(values)
    files: dict[str, str] = {}
    for folder in (COMMON, *kind.folders):
        root = TEMPLATES / folder
        for path in sorted(root.rglob(f"*{SUFFIX}")):
            name = _path_of(path.relative_to(root), plugin)
            files[name] = Template(path.read_text(encoding="utf-8")).substitute(values)
    return files


def _path_of(template: Path, plugin: Plugin) -> str:
    parts = [
        part.replace("PACKAGE", plugin.package).replace("NAME", plugin.short)
        for part in template.parts
    ]
    parts = ["." + part[4:] if part.startswith("dot-") else part for part in parts]
    return "/".join(parts).removesuffix(SUFFIX)


def _values(plugin: Plugin, kind: Kind) -> dict[str, str]:
    from fluxvla_core import __version__

    major, minor = (int(part) for part in __version__.split(".")[:2])
    bound = f">={major}.{minor},<{major}.{minor + 1}"
    extras = f"[{','.join(kind.extras)}]" if kind.extras else ""
    groups: dict[str, list[str]] = {}
    for part in kind.parts:
        name = class_name(plugin, part)
        target = f"{plugin.package}.{part.module}:{_attribute(plugin, part)}"
        groups.setdefault(part.registry, []).append(f'{name} = "{target}"')
    entry_points = "\n\n".join(
        "\n".join([f'[project.entry-points."fluxvla.{registry}"]', *lines])
        for registry, lines in groups.items()
    )
    return {
        "dist": plugin.dist,
        "package": plugin.package,
        "short": plugin.short,
        "stem": plugin.stem,
        "core": f"fluxvla-core{extras}{bound}",
        "core_testing": f"fluxvla-core[testing]{bound}",
        "entry_points": entry_points,
        "about": kind.about,
        "ci": f" {kind.ci}" if kind.ci else "",
        "type": class_name(plugin, kind.parts[0]),
        **{part.suffix: _attribute(plugin, part) for part in kind.parts},
    }


def _attribute(plugin: Plugin, part: Part) -> str:
    """The class's own name, which is the entry point's but for a command."""
    if part.registry == "commands":
        return plugin.stem.removesuffix(part.suffix) + part.suffix
    return class_name(plugin, part)


def write(files: Mapping[str, str], folder: Path) -> None:
    """Write ``files`` into the new ``folder``.

    Raises:
        UsageError: it exists already, or cannot be written.
    """
    try:
        folder.mkdir(parents=True)
        for name, text in files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
    except FileExistsError:
        raise UsageError(f"{folder} exists already; choose another name, or remove it") from None
    except OSError as error:
        raise UsageError(f"{folder} cannot be written: {error.strerror or error}") from error
