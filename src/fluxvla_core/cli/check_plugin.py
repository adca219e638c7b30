"""``fluxvla plugins check``: run the conformance kit that fits a class.

pytest runs the kit, silently and in this process; the results are printed here.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import io
import os
import sys
import tempfile
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

from fluxvla_core.cli.parser import Parser, add_plugin_files
from fluxvla_core.cli.terminal import say
from fluxvla_core.errors import EXIT_DONE, EXIT_FAILED, UsageError, nearest

KITS: Mapping[str, str] = {
    "action_filters": "ActionFilterConformance",
    "datasets": "DatasetConformance",
    "environments": "EnvironmentConformance",
    "hooks": "HookConformance",
    "metrics": "MetricConformance",
    "operators": "OperatorConformance",
    "policies": "PolicyConformance",
    "runners": "InferenceRunnerConformance",
    "transforms": "TransformConformance",
    "vlas": "ModelConformance",
}
"""Registry -> its kit in ``fluxvla_core.testing``; for runners, the kit of inference runners."""
TRAINS, EVALUATES = "TrainRunnerConformance", "EvalRunnerConformance"
"""The kits of other runners."""
INSTALL = "pip install 'fluxvla-core[testing]'"
_MODULE = "test_plugin.py"
_SOURCE = """\
import fluxvla_core.testing


class TestPlugin(fluxvla_core.testing.{kit}):
    entry_point = {name!r}
    arguments = {arguments!r}
"""


_STATES = ("ok", "skipped", "FAILED")


class Outcome(NamedTuple):
    """The result of one check: ``ok``, ``skipped`` or ``FAILED``, and its message."""

    check: str
    state: str
    words: str


class CheckPlugin:
    help = (
        "Run the conformance kit that fits a class, and say in words what is wrong. An operator's "
        "kit moves the robot that it connects to, and so asks for --hardware or --simulated."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.add_argument("name", help="a class's name, or distribution:name")
        parser.add_argument(
            "--set",
            dest="arguments",
            action="append",
            default=[],
            metavar="KEY=VALUE",
            help="an argument of its constructor (a TOML value)",
        )
        parser.once(
            "--kit",
            metavar="FILE",
            help="a Python file with subclasses of the kits, such as a plugin's own tests: those "
            "for this class are run",
        )
        behind = parser.add_mutually_exclusive_group()
        behind.add_argument(
            "--hardware",
            action="store_true",
            help="operators only: a real robot is connected; it is moved only once you have agreed "
            "at the terminal",
        )
        behind.add_argument(
            "--simulated", action="store_true", help="operators only: no real robot is connected"
        )
        add_plugin_files(parser)

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.plugins.registry import load_plugin_files

        if importlib.util.find_spec("pytest") is None:
            raise UsageError("the kits need pytest, which is not installed", next=INSTALL)
        load_plugin_files(args.plugin_files)
        registry = _registry_of(args.name)
        kit = _kit_of(registry, args.name, args.kit is not None)
        _agree(args, registry)
        if args.kit is not None and args.arguments:
            raise UsageError("--set is for a kit without a file; --kit has arguments of its own")
        found = list(_run(args, kit))
        if not found:
            raise UsageError(f"--kit {args.kit}: it has no kit whose entry_point is {args.name!r}")
        said: dict[str, str] = {}  # words -> the first check that said them
        for outcome in found:
            first = said.setdefault(outcome.words, outcome.check)
            again = outcome.state == "FAILED" and first != outcome.check
            say("\n".join(_lines(outcome._replace(words=f"as {first}") if again else outcome)))
        counts = {state: sum(o.state == state for o in found) for state in _STATES}
        say(f"{args.name}: {', '.join(f'{n} {state}' for state, n in counts.items() if n)}")
        return EXIT_FAILED if counts["FAILED"] else EXIT_DONE


def _registry_of(name: str) -> str:
    """The registry that has ``name``; of several the first that has a kit.

    Raises:
        UsageError: none has it.
        MissingPlugin: a first-party plugin would, that is not installed.
    """
    from fluxvla_core.plugins.registry import BY_NAME

    short = name.rpartition(":")[2]
    having = [registry for registry, one in BY_NAME.items() if short in one]
    if not having:
        from fluxvla_core.cli.plugin_commands import providers

        here = [n for one in BY_NAME.values() for n in one if one.registered(n) is not None]
        near = nearest(short, here)
        if near is not None:
            raise UsageError(f"nothing is called {name!r}; did you mean {near!r}?")
        providers(name)
    return next((registry for registry in having if registry in KITS), having[0])


def _kit_of(registry: str, name: str, own: bool) -> str:
    """The kit for the class; "" where only a file of the user's (``own``) can have one.

    Raises:
        UsageError: there is none.
        PluginError: the class is broken.
    """
    from fluxvla_core.plugins.registry import BY_NAME

    if registry not in KITS:
        raise UsageError(
            f"{name} is in fluxvla.{registry}, for which there is no kit; there are kits for "
            f"{', '.join(KITS)}",
            next="fluxvla plugins doctor checks its class",
        )
    cls = BY_NAME[registry].get(name)
    return _kit_of_runner(name, cls, own) if registry == "runners" else KITS[registry]


def _kit_of_runner(name: str, cls: type, own: bool) -> str:
    """By what its constructor takes; raises UsageError where no kit fits that."""
    from fluxvla_core.build import parameters
    from fluxvla_core.contracts.check import is_train_runner
    from fluxvla_core.plugins.registry import RUNNERS

    if is_train_runner(cls):
        if RUNNERS.registered(name) is None:
            return TRAINS
        raise UsageError(
            f"{name} is registered by a file, and train runners are tested in processes of their "
            "own, which know what is installed",
            next="pip install -e its distribution; fluxvla new-plugin begins one",
        )
    taken = set(parameters(cls))
    if {"operator", "policy"} <= taken:
        return KITS["runners"]
    if {"policy", "episodes"} <= taken:
        return EVALUATES
    if own:
        return ""
    raise UsageError(
        f"{name} neither trains, nor takes an operator and a policy to drive a robot, nor a policy "
        "and episodes to evaluate it, and the kits of runners are for these",
        next="fluxvla plugins doctor checks its class; a subclass of a kit says what its keys are "
        "called (--kit FILE)",
    )


def _agree(args: argparse.Namespace, registry: str) -> None:
    """Have a person agree before the kit of an operator moves a robot.

    Raises:
        UsageError: an operator without one of the options, another class with one, or a person who
            does not agree.
    """
    if registry != "operators":
        if args.hardware or args.simulated:
            raise UsageError(f"--hardware and --simulated are for operators; {args.name} is none")
        return
    moves = f"the kit of {args.name} moves what it connects to: every joint by 0.03 of its unit"
    if args.simulated:
        return
    if not args.hardware:
        raise UsageError(
            moves,
            next="--simulated, if no robot is behind it; --hardware, with a hand on the emergency "
            "stop: it asks you first",
        )
    if sys.stdin is None or not sys.stdin.isatty():
        raise UsageError(f"{moves}, and no person is at a terminal to agree to that")
    say(f"{moves}. Clear its space, and keep a hand on the emergency stop.")
    say(f"Type {args.name} to let it move:")
    if sys.stdin.readline().strip() != args.name:
        raise UsageError("not confirmed; nothing was moved")


def _arguments(words: list[str]) -> dict[str, Any]:
    """``KEY=VALUE`` words as constructor arguments.

    Raises:
        UsageError: one has no '='.
    """
    from fluxvla_core.config.overrides import parse_value

    arguments: dict[str, Any] = {}
    for word in words:
        key, sign, text = word.partition("=")
        if not sign or not key.isidentifier():
            raise UsageError(f"--set {word}: expected KEY=VALUE, with the name of an argument")
        arguments[key] = parse_value(text)
    return arguments


def _run(args: argparse.Namespace, kit: str) -> Iterator[Outcome]:
    """The outcomes of the kit, or of those in ``args.kit`` for this class."""
    import pytest

    short = args.name.rpartition(":")[2]
    collected = _Collected(short if args.kit is not None else None)
    arguments = _arguments(args.arguments)
    said = io.StringIO()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / _MODULE
        if args.kit is None:
            text = _SOURCE.format(kit=kit, name=args.name, arguments=arguments)
            path.write_text(text, encoding="utf-8")
        elif not Path(args.kit).is_file():
            raise UsageError(f"--kit {args.kit}: there is no such file")
        else:
            path = Path(args.kit).resolve()
        settings = Path(folder) / "pytest.ini"  # so that none of the present folder's applies
        settings.write_text("[pytest]\n", encoding="utf-8")
        # From the root, so that two files of one name are two modules.
        words = ["-q", "-c", str(settings), "--rootdir", path.anchor, "--tb=no"]
        words += ["-p", "no:cacheprovider", "--import-mode=importlib", str(path)]
        with (
            mock.patch.dict(os.environ, PYTEST_DISABLE_PLUGIN_AUTOLOAD="1", PYTEST_ADDOPTS=""),
            contextlib.redirect_stdout(said),
        ):
            code = pytest.main(words, plugins=[collected])
    if code == pytest.ExitCode.INTERRUPTED and not collected.problem:
        raise KeyboardInterrupt
    if collected.problem or code == pytest.ExitCode.INTERNAL_ERROR:
        raise UsageError(collected.problem or said.getvalue().strip())
    yield from collected.outcomes


class _Collected:
    """A plugin of pytest that collects the results.

    Args:
        name: only kits with this ``entry_point`` are run; None runs all.
    """

    def __init__(self, name: str | None) -> None:
        self.outcomes: list[Outcome] = []
        self.problem = ""
        self._name = name

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        if self._name is not None:
            items[:] = [item for item in items if self._is_for(item)]

    def _is_for(self, item: Any) -> bool:
        entry_point = getattr(item.cls, "entry_point", None) if item.cls is not None else None
        return isinstance(entry_point, str) and entry_point.rpartition(":")[2] == self._name

    def pytest_collectreport(self, report: Any) -> None:
        if report.failed:
            self.problem = f"the kit cannot be loaded: {_words(report)}"

    def pytest_runtest_logreport(self, report: Any) -> None:
        check = report.nodeid.rpartition("::")[2].removeprefix("test_").replace("_", " ")
        if report.skipped:
            self.outcomes.append(Outcome(check, "skipped", _words(report)))
        elif report.failed:
            self.outcomes.append(Outcome(check, "FAILED", _words(report)))
        elif report.when == "call":
            self.outcomes.append(Outcome(check, "ok", ""))


def _words(report: Any) -> str:
    """The message of a check, without the values that pytest adds."""
    if isinstance(report.longrepr, tuple):  # path, line, reason of a skip
        return str(report.longrepr[2]).removeprefix("Skipped: ")
    crash = getattr(report.longrepr, "reprcrash", None)
    text = str(report.longrepr) if crash is None else str(crash.message)
    return text.partition("\nassert ")[0].removeprefix("AssertionError: ").strip()


def _lines(outcome: Outcome) -> list[str]:
    indent = " " * 11
    words = textwrap.wrap(outcome.words, 100, initial_indent=indent, subsequent_indent=indent)
    return [f"  {outcome.state:8} {outcome.check}", *words]
