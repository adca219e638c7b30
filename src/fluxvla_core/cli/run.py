"""``fluxvla run``: from a config to a running section."""

from __future__ import annotations

import argparse
import errno
import json
import signal
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from fluxvla_core.atomic import prepare_folder
from fluxvla_core.cli import following, ranks
from fluxvla_core.cli.parser import Parser, add_overrides, add_plugin_files, natural, positive
from fluxvla_core.cli.plan import Plan, make_plan, refuse_overwriting
from fluxvla_core.contracts.reporter import Reporter
from fluxvla_core.errors import RunFailed, UsageError
from fluxvla_core.plugins.files import load_plugin_files
from fluxvla_core.signals import handling


class Run:
    api = "1.0"
    help = (
        "Run one section of a config: train with its runner, evaluate, or drive a robot. The "
        "config is checked as a whole first; a .py config is executed."
    )

    def add_arguments(self, parser: Parser) -> None:
        parser.once("--config", metavar="FILE", help="a .py, .toml or config.resolved.json")
        parser.once("--section", metavar="NAME", help="which section, if several can run")
        add_overrides(parser)
        parser.once("--work-dir", metavar="DIR", help="default: work_dirs/<name of the config>")
        parser.once(
            "--resume", metavar="auto|PATH", help="go on from the newest, or this, checkpoint"
        )
        parser.once("--task", metavar="ID|TEXT", help="what a robot is to do")
        parser.once("--tasks", metavar="FILE", help="what it is to do one after the other")
        parser.once("--record", metavar="DIR", help="record all of a robot's run, to be replayed")
        parser.once(
            "--nproc",
            type=positive,
            default=1,
            metavar="N",
            help="processes that train, or workers that evaluate (default 1)",
        )
        parser.once(
            "--max-restarts",
            type=natural,
            default=0,
            metavar="N",
            help="when a process of a training ends, start all again from the newest checkpoint",
        )
        parser.once(
            "--grace",
            type=positive,
            metavar="SECONDS",
            help="for processes to save when they are stopped, before they are killed "
            f"(default {ranks.GRACE_S})",
        )
        parser.add_argument(
            "--eval-after-train",
            action="store_true",
            help="then run the section 'eval', in a fresh process",
        )
        add_plugin_files(parser)
        parser.add_argument(
            "--dry-run", action="store_true", help="check, print what would run, and stop"
        )
        parser.once(
            "--log-format",
            choices=("text", "json"),
            default="text",
            help="for people (default) or one JSON object a line",
        )

    def run(self, args: argparse.Namespace) -> int:
        if ranks.has_agent():
            from fluxvla_core.cli.launch import die_with_parent

            die_with_parent()
        load_plugin_files(args.plugin_files)
        settings = {"record": args.record} if args.record is not None else {}
        plan = make_plan(args.config, args.section, args.overrides, args.work_dir, settings)
        _check_fit(args, plan)
        after = following.plan_evaluation(args, plan) if args.eval_after_train else None
        if args.dry_run:
            print(_outline(plan, args.log_format))
            return 0
        if ranks.rank() == 0 and not ranks.launched():
            prepare_folder(plan.work_dir, "work dir", "name another one: --work-dir DIR")
            if plan.trains:
                asked = ranks.resume(args.resume, plan.work_dir)
                configured = plan.config.tree[plan.section].get("resume_from")
                refuse_overwriting(plan.work_dir, asked or configured)
        if plan.trains and _launches(args):
            from fluxvla_core.cli.launch import launch

            grace = args.grace or ranks.GRACE_S
            with _terminable(), _disk_full(plan.work_dir):
                words, restarts = _words(args), args.max_restarts
                code, late = launch(args.nproc, words, plan.work_dir, restarts, grace)
        else:
            with _terminable(), _disk_full(plan.work_dir):
                late = _execute(plan, args)
                ranks.record_done(late)
            code = 0
        if code == 0 and after is not None and ranks.rank() == 0:
            following.evaluate(after, late)
        return code


def _check_fit(args: argparse.Namespace, plan: Plan) -> None:
    """Options that this kind of section has no use for are slips."""
    if plan.trains and (args.task is not None or args.tasks is not None):
        raise UsageError(f"--task says what a robot is to do, and section {plan.section!r} trains")
    if args.task is not None and args.tasks is not None:
        raise UsageError("--task and --tasks both say what to do: give one of them")
    if not plan.trains and args.resume is not None:
        raise UsageError(f"--resume is for training, and section {plan.section!r} does not train")
    for flag in ("max_restarts", "eval_after_train"):
        if getattr(args, flag) and not plan.trains:
            raise UsageError(
                f"--{flag.replace('_', '-')} is for training, and section {plan.section!r} does "
                "not train"
            )
    if args.grace is not None and not (plan.trains and _launches(args)):
        raise UsageError(
            "--grace is for the processes that --nproc or --max-restarts starts",
            next="leave it out: this one saves when it is stopped, however long that takes",
        )
    if args.nproc > 1 and not _divides(plan):
        raise UsageError(
            "--nproc is for processes that train or evaluate together, and section "
            f"{plan.section!r} runs in one",
            next="leave it out",
        )
    if args.resume not in (None, "auto") and not Path(args.resume).exists():
        raise UsageError(
            f"--resume {args.resume}: there is no such checkpoint",
            next="--resume auto takes the newest one of the work dir",
        )


def _divides(plan: Plan) -> bool:
    """Whether the section's runner trains or has ``workers``, or may have, for all one can read."""
    (signature,) = (use.found.signature for use in plan.uses if use.key == plan.section)
    if plan.trains or signature is None or signature.open:
        return True
    return "workers" in signature.names


def _launches(args: argparse.Namespace) -> bool:
    """Whether a training is done by other processes, which this one starts."""
    return bool(args.nproc > 1 or args.max_restarts)


def _words(args: argparse.Namespace) -> list[str]:
    """This command's arguments again, for its ranks."""
    words = ["--config", args.config]
    for name in ("section", "work_dir", "resume"):
        value = getattr(args, name)
        if value is not None:
            words += [f"--{name.replace('_', '-')}", value]
    for name, values in (("--set", args.overrides), ("--plugin", args.plugin_files)):
        words += [word for value in values for word in (name, value)]
    return [*words, "--log-format", args.log_format]


def _execute(plan: Plan, args: argparse.Namespace) -> int:
    """Build the section's runner and run it, reporting.

    Returns:
        The signal that asked to stop it when it was done, or 0.
    """
    from fluxvla_core.build import RunContext, build_runner_from_cfg
    from fluxvla_core.cli.reporters import make_reporter
    from fluxvla_core.config import freeze
    from fluxvla_core.contracts.reporter import SilentReporter

    context = RunContext(
        config=freeze(plan.config.tree),
        section=plan.section,
        work_dir=plan.work_dir,
        resume=ranks.resume(args.resume, plan.work_dir) if plan.trains else None,
        origins=plan.config.origins,
        config_file=plan.config.file,
        task=args.task,
        task_file=args.tasks,
        nproc=ranks.world_size() or args.nproc,
    )
    if ranks.rank() != 0:
        context = replace(context, reporter=SilentReporter())
        return _run_section(plan, build_runner_from_cfg, context)[1]
    reporter = make_reporter(args.log_format)
    try:
        with _owned(plan, reporter):
            _leave_records(plan)
            reporter.event("start", section=plan.section, work_dir=plan.work_dir)
            for text in ranks.restarted():
                reporter.warn(text)
            context = replace(context, reporter=reporter)
            result, late = _run_section(plan, build_runner_from_cfg, context)
        if isinstance(result, Mapping):
            for name, value in result.items():
                if isinstance(value, (bool, int, float, str)):
                    reporter.info(
                        f"{name}: {value:.6g}" if isinstance(value, float) else f"{name}: {value}"
                    )
            reporter.event("result", section=plan.section, result=result)
        reporter.artifact("work dir", plan.work_dir)
        return late
    except Exception as error:
        reporter.event("error", type=type(error).__name__, text=str(error))
        raise
    finally:
        reporter.close()


def _owned(plan: Plan, reporter: Reporter) -> AbstractContextManager[object]:
    """A training has its work dir for itself, from before it leaves the first file there."""
    if not plan.trains:
        return nullcontext()
    from fluxvla_core.checkpoints.owner import claim

    plan.work_dir.mkdir(parents=True, exist_ok=True)
    return closing(claim(plan.work_dir, reporter.warn))


def _run_section(plan: Plan, build: Any, context: Any) -> tuple[Any, int]:
    """The call order of the specification: construct, ``run_setup``, ``run``.

    Returns:
        What the section gave, and the signal that asked to stop it when it was done, or 0.
    """
    from fluxvla_core.contracts.check import is_train_runner

    runner = build(context.config[plan.section], context)
    if not is_train_runner(type(runner)):
        runner.run_setup()
        return runner.run(), 0
    from fluxvla_core.build import build_dataset_from_cfg

    dataset = build_dataset_from_cfg(context.config["train_dataloader"]["dataset"], context)
    try:
        runner.run_setup(n_train_examples=len(dataset))
        ranks.begin(plan.work_dir)
        return runner.run(dataset), getattr(runner, "late_stop", 0)
    except (RuntimeError, MemoryError, OSError) as error:
        from fluxvla_core.train.memory import explain

        known = explain(error)
        if known is None:
            raise
        raise known from error


def _leave_records(plan: Plan) -> None:
    """``config.resolved.json`` and ``environment.json``.

    A training's own stay at the top of its work dir; what is evaluated there later leaves its
    own in a folder of its section.
    """
    from fluxvla_core.config.resolved import (
        CONFIG_FILE,
        ENVIRONMENT_FILE,
        environment,
        write_json,
        write_resolved,
    )

    folder = plan.work_dir
    if not plan.trains and (folder / CONFIG_FILE).exists():
        folder = folder / plan.section
    folder.mkdir(parents=True, exist_ok=True)
    write_resolved(folder / CONFIG_FILE, plan.config)
    write_json(folder / ENVIRONMENT_FILE, environment())


def _outline(plan: Plan, log_format: str) -> str:
    """What ``--dry-run`` prints."""
    from fluxvla_core.cli.config_commands import listing, used

    if log_format == "json":
        outline = {
            "section": plan.section,
            "trains": plan.trains,
            "work_dir": str(plan.work_dir),
            "plugins": [
                {"key": u.key, "type": u.found.title, "provided_by": u.found.origin}
                for u in plan.uses
            ],
            "config": plan.config.tree,
            "origins": dict(plan.config.origins),
        }
        return json.dumps(outline)
    lines = [
        f"section: {plan.section} ({'trains' if plan.trains else 'does not train'})",
        f"work dir: {plan.work_dir}",
        "plugins:",
        *used(plan.uses),
        "config:",
        *(f"  {line}" for line in listing(plan.config, origin=True)),
    ]
    return "\n".join(lines)


class _Terminated(BaseException):
    """SIGTERM. Not an ``Exception``: nobody's ``except`` may swallow it."""


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM unwinds the stack as Ctrl-C does, so that everything that was opened is closed.

    Loops that know better (a robot's, a training's) take the signal over while they run.
    """

    def handle(number: int, frame: Any) -> None:
        raise _Terminated

    try:
        with handling(handle, signal.SIGTERM):
            yield
    except _Terminated:
        raise RunFailed("stopped by SIGTERM") from None


@contextmanager
def _disk_full(work_dir: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise RunFailed(
            f"no space left on the disk while writing {error.filename or work_dir}",
            next="make room and run the same command again, training with --resume auto",
        ) from error
