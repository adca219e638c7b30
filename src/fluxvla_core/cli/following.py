"""``--eval-after-train``: what a trained policy is worth, told by a process of its own.

A fresh process has the GPU to itself and nothing of the training in it: what it evaluates is what
anybody gets who is handed the checkpoint.
"""

from __future__ import annotations

import argparse
import os
import shlex
import signal
import sys

from fluxvla_core.cli.plan import Plan
from fluxvla_core.config import check_config
from fluxvla_core.errors import UsageError

SECTION = "eval"
_OF_A_RANK = ("MASTER_", "TORCHELASTIC_", "GROUP_", "ROLE_")
_OF_ONE_RANK = ("RANK", "LOCAL_RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE", "TORCH_NCCL_ASYNC_HANDLING")


def plan_evaluation(args: argparse.Namespace, plan: Plan) -> list[str]:
    """The words of the command that evaluates, checked before anything is trained.

    Raises:
        UsageError: the config has no section ``eval`` that evaluates.
        ConfigError: what is wrong with it.
    """
    checked = check_config(plan.config)
    if SECTION not in checked.sections or SECTION in checked.trains:
        others = [name for name in checked.sections if name not in checked.trains]
        raise UsageError(
            f"--eval-after-train needs a section {SECTION!r} that evaluates",
            where=plan.config.file,
            next=f"sections that do not train: {', '.join(others) or 'none'}",
        )
    words = ["run", "--config", args.config, "--section", SECTION]
    words += ["--work-dir", str(plan.work_dir), "--log-format", args.log_format]
    for name, values in (("--set", args.overrides), ("--plugin", args.plugin_files)):
        words += [word for value in values for word in (name, value)]
    return words


def evaluate(words: list[str], late: int = 0) -> None:
    """Become the process that evaluates: it keeps this one's id, terminal and signals.

    Args:
        late: a signal that asked to stop when training was done: then nothing new is begun.
    """
    if late:
        print(
            f"training is complete and saved, but not evaluated: {signal.Signals(late).name} came "
            f"at its end\n  next: fluxvla {shlex.join(words)}",
            file=sys.stderr,
        )
        return
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(_OF_A_RANK) and name not in _OF_ONE_RANK
    }
    sys.stdout.flush()
    sys.stderr.flush()
    os.execve(sys.executable, [sys.executable, "-m", "fluxvla_core", *words], environment)
