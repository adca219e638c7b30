"""Resume a training: choose the checkpoint, load its weights, restore random states.

Whether the run fits the checkpoint is checked by ``resume_checks``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torch import Tensor, nn

from fluxvla_core.atomic import prepare_folder
from fluxvla_core.build import RunContext
from fluxvla_core.checkpoints.checkpoint import (
    MODEL,
    TRAINER,
    Checkpoint,
    newest_whole,
    refuse_existing,
)
from fluxvla_core.checkpoints.lock import WorkDirLock, lock_work_dir
from fluxvla_core.checkpoints.manifest import FOLDER, step_name
from fluxvla_core.checkpoints.retention import clear_leftovers, name_best, set_aside_later
from fluxvla_core.errors import CheckpointError
from fluxvla_core.training.distributed import World, all_reduce_max, run_on_rank0
from fluxvla_core.training.lora import adapter_tensors
from fluxvla_core.training.progress import Progress, SavedTrainer
from fluxvla_core.training.rng import rank_seed, seed_all, set_rng_state
from fluxvla_core.training.saving import rng_file
from fluxvla_core.training.weights import LeftOut, SavedWeights, check_model_tensors

AUTO = "auto"


def lock_on_first(world: World, context: RunContext) -> WorkDirLock | None:
    """Make the work dir's ``checkpoints`` folder, and keep other trainings out; the first rank has
    the lock.

    Raises:
        UsageError: it cannot be written, or another training is using it.
    """
    locks: list[WorkDirLock] = []

    def take() -> str:
        prepare_folder(
            context.work_dir / FOLDER,
            "folder of the checkpoints",
            next="name a folder that can be written: --work-dir DIR",
        )
        locks.append(lock_work_dir(context.work_dir, context.reporter.warn))
        return ""

    run_on_rank0(world, take)
    return locks[0] if locks else None


def choose_checkpoint(
    world: World, context: RunContext, resume: str | None, first: str | None = None
) -> Checkpoint | None:
    """The verified checkpoint to resume from, None to start from scratch; the same on every rank.

    Also clears what killed saves left in the work dir, which :func:`lock_on_first` made this run's.

    Args:
        resume: ``auto`` (the newest whole one; a damaged newer one is named and passed over), a
            path (refused if damaged), or None (refused if there are checkpoints already).
        first: a path for ``auto`` where the work dir has no checkpoint yet: a restart before the
            first save starts from where the run did.

    Raises:
        CheckpointError: the one at the path is missing or damaged.
        UsageError: the work dir has checkpoints of another run.
    """
    found = run_on_rank0(world, lambda: _choose(context, resume, first))
    return Checkpoint.open(found) if found else None


def _choose(context: RunContext, resume: str | None, first: str | None) -> str:
    clear_leftovers(context.work_dir)
    reporter = context.reporter
    if resume is None:
        refuse_existing(context.work_dir)
        return ""
    checkpoint = _newest(context) if resume == AUTO else None
    if checkpoint is None:
        place = first if resume == AUTO else resume
        if place is None or place == AUTO:
            reporter.info(f"no checkpoint in {context.work_dir} yet: training starts from scratch")
            return ""
        checkpoint = Checkpoint.open(place)
        checkpoint.verify()
    if checkpoint.path.resolve().parent.parent == context.work_dir.resolve():
        for moved in set_aside_later(context.work_dir, checkpoint.step):
            reporter.warn(f"a later checkpoint is set aside as {moved.name}")
    else:
        refuse_existing(context.work_dir)
    reporter.info(f"resuming from {checkpoint.path} (step {checkpoint.step})")
    return str(checkpoint.path)


def _newest(context: RunContext) -> Checkpoint | None:
    checkpoint, refused = newest_whole(context.work_dir)
    if checkpoint is None and refused:
        raise refused[0]
    for error in refused:
        context.reporter.warn(
            f"not resuming from a damaged checkpoint: {error.where}: {error.what}"
        )
    return checkpoint


def load_weights(
    checkpoint: Checkpoint, model: nn.Module, brings: LeftOut | None
) -> dict[str, Tensor]:
    """The checkpoint's weights by name; all fit ``model``.

    Args:
        brings: the frozen weights that the model brings itself.

    Raises:
        CheckpointError: they are another model's, or other frozen weights go with them.
    """
    tensors = checkpoint.tensors(MODEL) | adapter_tensors(model, checkpoint)
    saved = checkpoint.json(TRAINER, SavedWeights)["left_out"]
    check_model_tensors(model, tensors, brings or LeftOut(), saved, str(checkpoint.path))
    return tensors


@contextmanager
def state_of(what: str, where: str) -> Iterator[None]:
    """Turn errors of ``load_state_dict`` into CheckpointError."""
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise CheckpointError(
            f"the saved state of the {what} does not fit: {type(error).__name__}: {error}",
            where=where,
            cause="another class wrote it, or the checkpoint was put together by hand",
        ) from error


def forget_missing(
    progress: Progress, world: World, work_dir: Path, resumed: Checkpoint | None
) -> None:
    """Let ``progress`` forget checkpoints that the ``resumed`` one knows and this work dir lacks.

    The best one may have been removed in favour of a better one that was lost since. Of a
    checkpoint from elsewhere, neither itself nor the best one before it is here.
    """
    elsewhere = lost = False
    if world.is_rank0:
        here = work_dir / FOLDER / step_name(progress.step)
        elsewhere = resumed is None or resumed.path.resolve() != here.resolve()
        lost = not name_best(work_dir, -1 if elsewhere else progress.best_step)
    if all_reduce_max(world, elsewhere):
        progress.saved = -1
    if all_reduce_max(world, lost):
        progress.best, progress.best_step = None, -1


def restore_rng(world: World, checkpoint: Checkpoint | None, seed: int) -> None:
    """Give this rank the random states it was saved with, or fresh ones of its own.

    With another number of ranks than before there are none to restore: each rank then draws from
    a state that follows from the seed, its rank and the step.
    """
    if checkpoint is None:
        seed_all(rank_seed(seed, world.rank))
        return
    seed_all(rank_seed(seed, world.rank, checkpoint.step))
    if checkpoint.json(TRAINER, SavedTrainer)["world_size"] == world.size:
        state = checkpoint.tensors(rng_file(world.rank))
        with state_of("random generators", str(checkpoint.path)):
            set_rng_state(state)
