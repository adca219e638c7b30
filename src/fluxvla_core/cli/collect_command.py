"""``fluxvla data collect``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluxvla_core.cli.parser import Parser, add_plugin_files, positive
from fluxvla_core.errors import ConfigError, UsageError

if TYPE_CHECKING:
    from fluxvla_core.evaluate.demonstrating import Collection

SIDES = {"env": "environment", "policy": "policy"}


class Collect:
    api = "1.0"
    help = (
        "Record demonstrations of a policy in an environment, the environment's scripted expert by "
        "default, as a LeRobot v3.0 dataset with videos."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.once("--env", required=True, metavar="TYPE", help="one of fluxvla.environments")
        parser.once(
            "--policy", default="expert", metavar="TYPE", help="one of fluxvla.policies, or expert"
        )
        parser.once("--episodes", type=positive, required=True, metavar="N", help="how many")
        parser.once("--out", required=True, metavar="DIR", help="the dataset to make")
        parser.once("--tasks", nargs="+", metavar="NAME", help="all of the environment's")
        parser.once("--seed", type=int, default=10_000, help="of the first episode: 10000")
        parser.once("--cameras", nargs="+", metavar="NAME", help="all of the environment's")
        parser.once("--height", type=positive, help="of the pictures; the cameras' own")
        parser.once("--width", type=positive, help="of the pictures; the cameras' own")
        parser.once("--workers", type=positive, default=2, metavar="N", help="default 2")
        parser.add_argument("--resume", action="store_true", help="go on with an interrupted one")
        parser.add_argument(
            "--failures", action="store_true", help="keep what did not succeed, too"
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
        parser.once("--log-format", choices=("text", "json"), default="text", help="of progress")

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.evaluate.demonstrating import Collection
        from fluxvla_core.plugins.files import load_plugin_files

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
        record(collection, args)
        return 0


def record(collection: Collection, args: argparse.Namespace) -> None:
    """Collect, and tell about it, as ``args`` says: out, workers, resume and log_format."""
    from fluxvla_core.cli.reporters import make_reporter
    from fluxvla_core.evaluate.demonstrating import collect

    reporter = make_reporter(args.log_format)
    try:
        reporter.info(f"collecting {collection.episodes} demonstrations into {Path(args.out)}")
        found = collect(args.out, collection, args.workers, args.resume, reporter)
        again = f", {found['retried']} tried again" if found["retried"] else ""
        reporter.info(
            f"{found['episodes']} episodes, {found['frames']} new frames{again} in "
            f"{found['seconds']:.0f} s: {found['frames_per_s']:.1f} frames/s"
        )
    finally:
        reporter.close()


def arguments(env: str, policy: str, settings: Sequence[str]) -> dict[str, Any]:
    """The tables ``environment`` and ``policy``, checked against the classes' constructors.

    Args:
        settings: ``env.NAME=VALUE`` and ``policy.NAME=VALUE``.

    Raises:
        UsageError: a setting is neither.
        ConfigError: a class takes no such argument, or is not there.
    """
    from fluxvla_core.config import Config, examine
    from fluxvla_core.config.overrides import parse_value
    from fluxvla_core.evaluate.policies import EXPERT, resolve_name

    tables: dict[str, Any] = {"environment": {"type": env}, "policy": {"type": policy}}
    origins = {"environment": f"--env {env}", "policy": f"--policy {policy}"}
    for text in settings:
        key, equals, value = text.partition("=")
        side, dot, name = key.strip().partition(".")
        if side not in SIDES or not (dot and equals and name):
            raise UsageError(
                f"--set {text}: it is env.NAME=VALUE or policy.NAME=VALUE",
                next="fluxvla data collect --help",
            )
        tables[SIDES[side]][name] = parse_value(value.strip())
        origins[f"{SIDES[side]}.{name}"] = f"--set {text}"
    if policy == EXPERT:
        # Which class that is, the environment's says.
        from fluxvla_core.plugins.registry import ENVIRONMENTS

        named = resolve_name(EXPERT, ENVIRONMENTS.get(env))
        assert isinstance(named, dict)
        tables["policy"] = {**tables["policy"], **named}
    elif isinstance(named := resolve_name(policy, None), dict):
        tables["policy"] = {**tables["policy"], **named}
    checked = examine(Config(tables, origins, "fluxvla data collect"))
    if checked.problems:
        raise ConfigError.from_problems(checked.problems)
    return tables
