"""``fluxvla run``: from a config to a running section."""

from __future__ import annotations

import argparse
import os
import re
import shlex
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fluxvla_core.atomic import prepare_folder
from fluxvla_core.cli import ranks
from fluxvla_core.cli.execute import (
    execute,
    folders_to_make,
    full_disk_explained,
    remove_folders,
    stopped_by_signals,
)
from fluxvla_core.cli.parser import Parser, add_overrides, add_plugin_files, natural, positive
from fluxvla_core.cli.plan import Plan, make_plan, refuse_overwriting
from fluxvla_core.cli.terminal import say
from fluxvla_core.config.check import check_config
from fluxvla_core.errors import EXIT_BAD_INPUT, FluxError, UsageError
from fluxvla_core.plugins.registry import load_plugin_files

EVALUATION = "eval"
_RANK_VARIABLES = re.compile(
    r"(MASTER|TORCHELASTIC|GROUP|ROLE)_.*|(LOCAL_)?(RANK|WORLD_SIZE)|TORCH_NCCL_ASYNC_HANDLING"
)
"""Environment variables that torch's launcher sets for its ranks."""


class Run:
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
            "--resume", metavar="auto|PATH", help="resume from the newest checkpoint, or from PATH"
        )
        parser.once("--task", metavar="ID|TEXT", help="task id or instruction for the robot")
        parser.once("--tasks", metavar="FILE", help="file of tasks, done in order")
        parser.add_argument(
            "--free-task",
            action="store_true",
            help="also take instructions that the config does not know",
        )
        parser.once("--record", metavar="DIR", help="record the robot's run to DIR, for replay")
        parser.once(
            "--nproc",
            type=positive,
            metavar="N",
            help="processes that train (default 1), or evaluation workers (default: as configured)",
        )
        parser.once(
            "--max-restarts",
            type=natural,
            default=0,
            metavar="N",
            help="how often to restart all processes from the newest checkpoint when one fails",
        )
        parser.once(
            "--grace",
            type=positive,
            metavar="SECONDS",
            help="time that processes have to save when they are stopped, before they are killed "
            f"(default {ranks.GRACE_S})",
        )
        parser.add_argument(
            "--eval-after-train",
            action="store_true",
            help="after training, run the section 'eval' in a new process",
        )
        add_plugin_files(parser)
        parser.add_argument(
            "--dry-run", action="store_true", help="check, print what would run, and stop"
        )
        parser.once(
            "--log-format",
            choices=("text", "json"),
            default="text",
            help="text (default), or one JSON object per line",
        )

    def run(self, args: argparse.Namespace) -> int:
        if ranks.has_agent():
            from fluxvla_core.cli.launch import die_with_parent

            die_with_parent()
        load_plugin_files(args.plugin_files)
        settings = {"record": args.record} if args.record is not None else {}
        plan = make_plan(args.config, args.section, args.overrides, args.work_dir, settings)
        _check_options(args, plan)
        after = _plan_evaluation(args, plan) if args.eval_after_train else None
        if args.dry_run:
            from fluxvla_core.cli.dry_run import outline
            from fluxvla_core.config.overrides import complete_hints

            text, refused = outline(plan, args.log_format, args.nproc)
            say(text)
            if refused is not None:
                with complete_hints(plan.config.tree, plan.section):
                    raise refused
            return 0
        if plan.trains:
            ranks.refuse_lost_work_dir()
        if ranks.launched():
            return self._perform(plan, args, after)
        made = folders_to_make(plan)
        try:
            with _resume_hint(plan):
                code = self._perform(plan, args, after)
        except FluxError as error:
            if error.exit_code == EXIT_BAD_INPUT and ranks.rank() == 0:
                remove_folders(made)
            raise
        if code == EXIT_BAD_INPUT:  # of a process that this one started
            remove_folders(made)
        return code

    def _perform(self, plan: Plan, args: argparse.Namespace, after: list[str] | None) -> int:
        if ranks.rank() == 0 and not ranks.launched():
            prepare_folder(plan.work_dir, "work dir", "name another one: --work-dir DIR")
            if plan.trains:
                asked = ranks.resume_from(args.resume, plan.work_dir)
                configured = plan.config.tree[plan.section].get("resume_from")
                refuse_overwriting(plan.work_dir, asked or configured)
        if plan.trains and _launches(args):
            from fluxvla_core.cli.choose_reporter import make_reporter
            from fluxvla_core.cli.launch import launch

            grace = args.grace or ranks.GRACE_S
            reporter = make_reporter(args.log_format)
            reporter.info(f"starting {args.nproc or 1} processes")
            reporter.close()
            with stopped_by_signals(), full_disk_explained(plan.work_dir):
                argv, restarts = _command_line(args), args.max_restarts
                code, late = launch(args.nproc or 1, argv, plan.work_dir, restarts, grace)
        else:
            with stopped_by_signals(), full_disk_explained(plan.work_dir):
                late = execute(plan, args)
                ranks.record_finished(late)
            code = 0
        if code == 0 and after is not None and ranks.rank() == 0:
            _evaluate(after, late)
        return code


@contextmanager
def _resume_hint(plan: Plan) -> Iterator[None]:
    """After Ctrl-C, print what is kept and how to continue."""
    try:
        yield
    except KeyboardInterrupt as error:
        if isinstance(error.__cause__, FluxError):  # it says how itself
            raise
        signature, said = plan.signature, str(error)
        if plan.trains:
            way = "run the same command again with --resume auto"
        elif signature is not None and "episodes" in signature.names:
            said = said or "finished episodes are kept"
            way = "run the same command again"
        else:
            raise
        raise KeyboardInterrupt(f"{said}\n  next: {way}" if said else way) from error


def _check_options(args: argparse.Namespace, plan: Plan) -> None:
    """Refuse options that this kind of section has no use for."""
    section = f"section {plan.section!r}"
    if plan.trains and (args.task is not None or args.tasks is not None):
        raise UsageError(f"--task says what a robot is to do, and {section} trains")
    if plan.trains and args.free_task:
        raise UsageError(f"--free-task is for a robot, and {section} trains")
    if args.task is not None and args.tasks is not None:
        raise UsageError("--task and --tasks both say what to do: give one of them")
    for name in ("resume", "max_restarts", "eval_after_train"):
        if not plan.trains and getattr(args, name) not in (None, 0, False):
            flag = name.replace("_", "-")
            raise UsageError(f"--{flag} is for training, and {section} does not train")
    if args.grace is not None and not (plan.trains and _launches(args)):
        raise UsageError(
            "--grace is for the processes that --nproc or --max-restarts starts",
            next="leave it out: this one saves when it is stopped, however long that takes",
        )
    if (args.nproc or 1) > 1 and not _divides(plan):
        raise UsageError(
            f"--nproc is for processes that train or evaluate together, and {section} runs in one",
            next="leave it out",
        )
    if args.resume not in (None, "auto") and not Path(args.resume).exists():
        raise UsageError(
            f"--resume {args.resume}: there is no such checkpoint",
            next="--resume auto takes the newest one of the work dir",
        )


def _divides(plan: Plan) -> bool:
    """Whether the section's runner trains or has ``workers``, or its signature is unreadable."""
    signature = plan.signature
    return plan.trains or signature is None or signature.open or "workers" in signature.names


def _launches(args: argparse.Namespace) -> bool:
    """Whether a training is done by other processes, which this one starts."""
    return bool((args.nproc or 1) > 1 or args.max_restarts)


def _command_line(args: argparse.Namespace) -> list[str]:
    """This command's arguments again, for its ranks."""
    argv = ["--config", args.config]
    for name in ("section", "work_dir", "resume"):
        value = getattr(args, name)
        if value is not None:
            argv += [f"--{name.replace('_', '-')}", value]
    return [*argv, *_repeated(args)]


def _repeated(args: argparse.Namespace) -> list[str]:
    """The options of the config and of progress again, for another process."""
    options = [("--set", o) for o in args.overrides] + [("--plugin", f) for f in args.plugin_files]
    return [word for option in [*options, ("--log-format", args.log_format)] for word in option]


# -- --eval-after-train -----------------------------------------------------------------------


def _plan_evaluation(args: argparse.Namespace, plan: Plan) -> list[str]:
    """The arguments of the command that evaluates, checked before anything is trained.

    Raises:
        UsageError: the config has no section ``eval`` that evaluates.
        ConfigError: what is wrong with it.
    """
    checked = check_config(plan.config)
    if EVALUATION not in checked.sections or EVALUATION in checked.trains:
        others = [name for name in checked.sections if name not in checked.trains]
        raise UsageError(
            f"--eval-after-train needs a section {EVALUATION!r} that evaluates",
            where=plan.config.file,
            next=f"sections that do not train: {', '.join(others) or 'none'}",
        )
    argv = ["run", "--config", args.config, "--section", EVALUATION]
    return [*argv, "--work-dir", str(plan.work_dir), *_repeated(args)]


def _evaluate(argv: list[str], late: int) -> None:
    """Become the process that evaluates: it keeps this one's id, terminal and signals.

    Args:
        late: a signal that asked to stop when training was done: then nothing new is begun.
    """
    if late:
        say(
            f"training is complete and saved, but not evaluated: {signal.Signals(late).name} came "
            f"at its end\n  next: fluxvla {shlex.join(argv)}",
            sys.stderr,
        )
        return
    environment = {n: value for n, value in os.environ.items() if not _RANK_VARIABLES.fullmatch(n)}
    sys.stdout.flush()
    sys.stderr.flush()
    os.execve(sys.executable, [sys.executable, "-m", "fluxvla_core", *argv], environment)
