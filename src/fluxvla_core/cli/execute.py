"""Run one section of a config in this process, and write the records in its work dir."""

from __future__ import annotations

import argparse
import errno
import signal
from collections.abc import Iterator, Mapping
from contextlib import (
    AbstractContextManager,
    closing,
    contextmanager,
    nullcontext,
    suppress,
)
from dataclasses import replace
from pathlib import Path
from typing import Any

from fluxvla_core.cli import ranks
from fluxvla_core.cli.plan import Plan
from fluxvla_core.config.load import CONFIG_FILE
from fluxvla_core.contracts.runner import Reporter
from fluxvla_core.errors import RunFailed
from fluxvla_core.signals import handling, ignore, requests_to_stop


def execute(plan: Plan, args: argparse.Namespace) -> int:
    """Build the section's runner and run it, reporting.

    Returns:
        The signal that asked to stop it when it was done, or 0.
    """
    from fluxvla_core.build import RunContext, build_runner_from_cfg
    from fluxvla_core.cli.choose_reporter import make_reporter
    from fluxvla_core.cli.reporters import KeepAliveReporter
    from fluxvla_core.config.tree import freeze
    from fluxvla_core.contracts.runner import SilentReporter

    context = RunContext(
        config=freeze(plan.config.tree),
        section=plan.section,
        work_dir=plan.work_dir,
        resume=ranks.resume_from(args.resume, plan.work_dir) if plan.trains else None,
        origins=plan.config.origins,
        config_file=plan.config.file,
        task=args.task,
        task_file=args.tasks,
        free_task=args.free_task,
        nproc=ranks.world_size() or args.nproc or (1 if plan.trains else None),
    )
    if ranks.rank() != 0:
        context = replace(context, reporter=SilentReporter())
        return _run_section(plan, build_runner_from_cfg, context)[1]
    reporter = KeepAliveReporter(make_reporter(args.log_format))
    try:
        with _work_dir_lock(plan, reporter):
            first = _write_run_records(plan)
            reporter.event("start", section=plan.section, work_dir=plan.work_dir)
            for text in ranks.restart_notice():
                reporter.warn(text)
            context = replace(context, reporter=reporter)
            result, late = _run_section(plan, build_runner_from_cfg, context, not first)
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


def _work_dir_lock(plan: Plan, reporter: Reporter) -> AbstractContextManager[object]:
    """Lock the work dir of a training, before its first file is written there."""
    if not plan.trains:
        return nullcontext()
    from fluxvla_core.checkpoints.lock import lock_work_dir

    plan.work_dir.mkdir(parents=True, exist_ok=True)
    return closing(lock_work_dir(plan.work_dir, reporter.warn))


def _run_section(
    plan: Plan, build: Any, context: Any, own_records: bool = False
) -> tuple[Any, int]:
    """Run a section: construct its runner, call ``run_setup``, then ``run``.

    Args:
        own_records: write the config and the environment to the section's own folder, unless the
            runner keeps them beside its results (``Runner.keeps_config``).

    Returns:
        The runner's result, and the signal that asked to stop it when it was done, or 0.
    """
    from fluxvla_core.config.overrides import complete_hints
    from fluxvla_core.contracts.check import is_train_runner
    from fluxvla_core.contracts.runner import Runner

    with complete_hints(plan.config.tree, plan.section):
        runner = build(context.config[plan.section], context)
        if is_train_runner(type(runner)):
            return _train(plan, runner, context)
        if own_records and not Runner.adapt(runner).keeps_config:
            _write_records(plan, plan.work_dir / plan.section)
        runner.run_setup()
        return runner.run(), 0


def _train(plan: Plan, runner: Any, context: Any) -> tuple[Any, int]:
    from fluxvla_core.build import build_dataset_from_cfg
    from fluxvla_core.contracts.runner import TrainRunner
    from fluxvla_core.errors import located
    from fluxvla_core.training.base_runner import BaseTrainRunner
    from fluxvla_core.training.fit_checks import check_data

    with located(context.where("train_dataloader.dataset")):
        dataset = build_dataset_from_cfg(context.config["train_dataloader"]["dataset"], context)
    if isinstance(runner, BaseTrainRunner):  # another's collator may not be an attribute
        if runner.val_options is not None:
            from fluxvla_core.training.validation import validation_dataset  # imports torch

            runner.val_dataset = validation_dataset(context, dataset, runner.options.seed)
        check_data(context, dataset, runner.collator, runner.val_dataset)
    try:
        runner.run_setup(n_train_examples=len(dataset))
        ranks.mark_started(plan.work_dir)
        return runner.run(dataset), TrainRunner.adapt(runner).late_stop
    except (RuntimeError, MemoryError, OSError) as error:
        from fluxvla_core.training.failures import explain

        known = explain(error)
        if known is None:
            raise
        raise known from error


def _write_run_records(plan: Plan) -> bool:
    """``config.resolved.json`` and ``environment.json`` at the top of the work dir, and whether
    they were written: a training's own stay when something is evaluated there later."""
    if not plan.trains and (plan.work_dir / CONFIG_FILE).exists():
        return False
    _write_records(plan, plan.work_dir)
    return True


def _write_records(plan: Plan, folder: Path) -> None:
    from fluxvla_core import atomic
    from fluxvla_core.config.load import ENVIRONMENT_FILE, environment, write_resolved

    folder.mkdir(parents=True, exist_ok=True)
    write_resolved(folder / CONFIG_FILE, plan.config)
    atomic.write_json(folder / ENVIRONMENT_FILE, environment())


def folders_to_make(plan: Plan) -> list[Path]:
    """Folders that a run of ``plan`` makes, inner ones first."""
    from fluxvla_core.checkpoints.manifest import FOLDER

    inner = [plan.work_dir / name for name in (plan.section, FOLDER)]
    folders = [*inner, plan.work_dir, *plan.work_dir.parents]
    return [path for path in folders if not path.exists()]


def remove_folders(made: list[Path]) -> None:
    """Remove the folders of a run that was refused; one with other files in it stays."""
    with suppress(OSError):
        for folder in made:
            _remove_records(folder)


def _remove_records(folder: Path) -> None:
    """Remove a folder that holds only the files that every run writes as it begins."""
    from fluxvla_core.checkpoints.lock import LOCK
    from fluxvla_core.config.load import ENVIRONMENT_FILE

    inside = list(folder.iterdir()) if folder.is_dir() else []
    if {path.name for path in inside} <= {CONFIG_FILE, ENVIRONMENT_FILE, LOCK}:
        for path in inside:
            path.unlink()
        with suppress(FileNotFoundError):  # nothing was left there yet
            folder.rmdir()


class _Terminated(BaseException):
    """SIGTERM or SIGHUP. Not an ``Exception``: nobody's ``except`` may swallow it."""


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """SIGTERM and SIGHUP unwind the stack as Ctrl-C does, so that everything is closed.

    A robot's or a training's loop handles the signals itself while it runs. A rank that failed
    ignores them from then on, SIGINT as well: torch's agent asks all ranks to stop as soon as one
    of them has failed, and this one's own error is still to be reported.
    """

    def handle(number: int, frame: Any) -> None:
        raise _Terminated(number)

    numbers = requests_to_stop()
    try:
        with handling(handle, *(n for n in numbers if n != signal.SIGINT)):
            try:
                yield
            except BaseException:
                if ranks.has_agent():
                    ignore(numbers)
                raise
    except _Terminated as ended:
        name = signal.Signals(ended.args[0]).name
        raise RunFailed(f"stopped by {name}", reason="stopped") from None


@contextmanager
def full_disk_explained(work_dir: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise RunFailed(
            f"no space left on the disk while writing {error.filename or work_dir}",
            next="make room and run the same command again, training with --resume auto",
        ) from error
