"""Render a new plugin: a complete distribution, from the templates of ``fluxvla_core/templates``.

A template is a file whose name ends with ``.tmpl``, with the placeholders of ``string.Template``.
Its path below the folder of its kind is that of the file that it becomes: ``PACKAGE`` stands for
the import package, ``NAME`` for the plugin's short name, and a leading ``dot-`` for a dot.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from string import Template

from fluxvla_core.errors import UsageError, nearest

TEMPLATES = Path(__file__).resolve().parents[1] / "templates"
PREFIX = "fluxvla-"
SUFFIX = ".tmpl"
COMMON = "common"
# PEP 508's rule for names.
_NAME = re.compile(r"[A-Za-z0-9]|[A-Za-z0-9][A-Za-z0-9._-]*[A-Za-z0-9]")
_LONGEST = 32
"""Characters of a name: paths and class names stay readable."""


@dataclass(frozen=True)
class Part:
    """A class of a rendered plugin: its registry, what its name ends with, and its module."""

    registry: str
    suffix: str
    module: str


@dataclass(frozen=True)
class Kind:
    """What is rendered for one kind of plugin.

    Args:
        parts: the classes that it registers; the first is the one that it is about.
        folders: of templates, after ``common``; a later one replaces files of an earlier one.
        about: what the distribution is, in its metadata and its package's docstring.
        extras: of the core, that it cannot work without.
        run: the command that runs it, in the folder of the distribution.
        beside: the command that has to run meanwhile, in another terminal.
        ci: what its CI installs besides.
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
    "model": Kind(
        (Part("vlas", "VLA", "model"),),
        ("training", "model"),
        "A model for FluxVLA",
        ("train",),
        RUN_STAND_IN,
    ),
    "environment": Kind(
        (
            Part("environments", "Environment", "environment"),
            Part("policies", "Expert", "expert"),
        ),
        ("environment",),
        "An environment for FluxVLA",
        (),
        RUN,
    ),
    "dataset": Kind(
        (Part("datasets", "Dataset", "dataset"),),
        ("training", "dataset"),
        "A dataset for FluxVLA",
        ("train",),
        RUN_STAND_IN,
    ),
    "transform": Kind(
        (Part("transforms", "Transform", "transform"),),
        ("training", "transform"),
        "A transform for FluxVLA",
        ("train",),
        RUN_STAND_IN,
    ),
    "hook": Kind(
        (Part("hooks", "Hook", "hook"),),
        ("training", "hook"),
        "A hook for FluxVLA",
        ("train",),
        RUN_STAND_IN,
    ),
    "metric": Kind(
        (Part("metrics", "Metric", "metric"),),
        ("training", "metric"),
        "A metric for FluxVLA",
        ("train",),
        RUN_STAND_IN,
    ),
    "command": Kind(
        (Part("commands", "Command", "command"),),
        ("command",),
        "A command for FluxVLA",
        (),
        "fluxvla ${type}",
    ),
    "train-runner": Kind(
        (Part("runners", "TrainRunner", "runner"),),
        ("training", "train-runner"),
        "A training strategy for FluxVLA",
        ("train",),
        RUN_STAND_IN,
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
