"""Choosing the checkpoint that a run goes on from, and refusing one that it cannot go on from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluxvla_core.build import RunContext
from fluxvla_core.checkpoints.checkpoint import (
    EMA,
    MODEL,
    OPTIMIZER_META,
    TRAINER,
    Checkpoint,
    folders,
    newest_whole,
)
from fluxvla_core.checkpoints.owner import Claim, claim
from fluxvla_core.checkpoints.shelf import clear_leftovers, prepare, set_aside_later
from fluxvla_core.errors import CheckpointError, UsageError
from fluxvla_core.train.batches import StepPlan
from fluxvla_core.train.changes import changed_settings, changed_statistics, plain
from fluxvla_core.train.distributed import World, on_first
from fluxvla_core.train.lora import LoraOptions, adapter_tensors
from fluxvla_core.train.optim import ScheduledLR
from fluxvla_core.train.progress import Progress
from fluxvla_core.train.saving import rng_file
from fluxvla_core.train.state import rank_seed, seed_all, seeds_of, set_rng_state
from fluxvla_core.train.weights import LeftOut, check_model_tensors

if TYPE_CHECKING:
    from fluxvla_core.train.strategy import Strategy

AUTO = "auto"


def take_over(world: World, context: RunContext) -> Claim | None:
    """Make the work dir's ``checkpoints`` folder, and keep other trainings out; the first rank has
    the claim.

    Raises:
        UsageError: it cannot be written, or another training is using it.
    """
    claims: list[Claim] = []

    def take() -> str:
        prepare(context.work_dir)
        claims.append(claim(context.work_dir, context.reporter.warn))
        return ""

    on_first(world, take)
    return claims[0] if claims else None


def choose(
    world: World, context: RunContext, resume: str | None, first: str | None = None
) -> Checkpoint | None:
    """The verified checkpoint to go on from, None to start afresh; the same on every rank.

    Also clears what killed saves left in the work dir, which :func:`take_over` made this run's.

    Args:
        resume: ``auto`` (the newest whole one; a damaged newer one is named and passed over), a
            path (refused if damaged), or None (refused if there are checkpoints already).
        first: a path for ``auto`` where the work dir has no checkpoint yet: a restart before the
            first save goes on from where the run did.

    Raises:
        CheckpointError: the one at the path is missing or damaged.
        UsageError: the work dir has checkpoints of another run.
    """
    found = on_first(world, lambda: _choose(context, resume, first))
    return Checkpoint.open(found) if found else None


def _choose(context: RunContext, resume: str | None, first: str | None) -> str:
    clear_leftovers(context.work_dir)
    reporter = context.reporter
    if resume is None:
        _refuse_existing(context.work_dir)
        return ""
    checkpoint = _newest(context) if resume == AUTO else None
    if checkpoint is None:
        place = first if resume == AUTO else resume
        if place is None or place == AUTO:
            reporter.info(f"no checkpoint in {context.work_dir} yet: training starts afresh")
            return ""
        checkpoint = Checkpoint.open(place)
        checkpoint.verify()
    if checkpoint.path.resolve().parent.parent == context.work_dir.resolve():
        for moved in set_aside_later(context.work_dir, checkpoint.step):
            reporter.warn(f"a later checkpoint is set aside as {moved.name}")
    else:
        _refuse_existing(context.work_dir)
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


def _refuse_existing(work_dir: Path) -> None:
    existing = folders(work_dir)
    if existing:
        raise UsageError(
            f"{work_dir} already has checkpoints, up to {existing[-1].name}",
            next="go on from there with --resume auto, or name another --work-dir",
        )


def check_same_run(
    saved: Mapping[str, Any], plan: StepPlan, seeds: Sequence[int | None], where: str
) -> str | None:
    """Refuse to go on with other data or another seed; a changed batch or world only is said.

    Args:
        saved: ``trainer.json``.
        seeds: what the dataset, and those it is made of, draw by.

    Returns:
        One line to warn with when steps will use other numbers of samples than before, or None.

    Raises:
        CheckpointError: another seed or number of samples, under which the order would change.
    """
    together = plan.shards and plan.shards.together
    theirs = saved.get("data_seeds", seeds)
    for ours, before, what in (
        (plan.seed, saved.get("seed"), "seed"),
        (plan.length, saved.get("n_train_examples"), "number of samples in the dataset"),
        (together, saved.get("shuffle_episodes"), "value of shuffle_episodes"),
        (_listed(seeds), _listed(theirs), "seed of the dataset"),
    ):
        if before != ours:
            raise CheckpointError(
                f"the {what} is {ours}, the checkpoint's run had {before}",
                where=where,
                cause="the rest of its epoch would be another one's",
                next="set it back, or start a new run in another --work-dir",
            )
    if saved["step_samples"] != plan.step_samples:
        return (
            f"steps use {plan.step_samples} samples now and {saved['step_samples']} in the "
            "checkpoint's run: the order of samples stays, the result will differ"
        )
    if saved["world_size"] != plan.world:
        return (
            f"the number of processes is {plan.world}, the checkpoint's run had "
            f"{saved['world_size']}: the order of samples stays, results agree only to rounding"
        )
    return None


def _listed(seeds: Sequence[int | None]) -> str:
    return ", ".join(map(str, seeds))


def check_same_adapter(ours: LoraOptions | None, theirs: LoraOptions | None, where: str) -> None:
    """Refuse to go on with another adapter than the checkpoint's, or with one, or without.

    Raises:
        CheckpointError: says both.
    """
    mine, saved = (None if o is None else o.for_peft() for o in (ours, theirs))
    if mine != saved:
        raise CheckpointError(
            f"lora is {_shown(mine)}, the checkpoint's run had {_shown(saved)}",
            where=where,
            next="set it back; or begin another run from these weights: init_from = "
            "'<this checkpoint>' and another --work-dir",
        )


def check_same_averages(decay: float | None, checkpoint: Checkpoint) -> None:
    """Refuse to go on without the averages that the checkpoint has, or with ones it has not.

    Raises:
        CheckpointError: says which.
    """
    if (decay is not None) == checkpoint.has(EMA):
        return
    if decay is not None:
        what = "ema_decay is set, and the checkpoint's run kept no averaged weights"
        back = "resume without ema_decay"
    else:
        what = "ema_decay is not set, and the checkpoint's run kept averaged weights, which act"
        back = "set it back: the checkpoint's config.resolved.json has its value"
    raise CheckpointError(
        what,
        where=str(checkpoint.path),
        next=f"{back}; or begin another run from these weights: init_from = '<this checkpoint>' "
        "and another --work-dir",
    )


def check_same_statistics(dataset: Any, checkpoint: Checkpoint) -> None:
    """Refuse to go on with data that are normalised by other numbers.

    Raises:
        CheckpointError: names the statistics that differ.
    """
    ours = plain(dict(getattr(dataset, "statistics", None) or {}))
    changed = changed_statistics(checkpoint.statistics(), ours)
    if changed:
        named = ", ".join(changed[:6]) + (", …" if len(changed) > 6 else "")
        raise CheckpointError(
            f"the dataset's statistics are not those of the checkpoint's run: {named}",
            where=str(checkpoint.path),
            cause="other data, episodes or settings of the dataset: states and actions would now "
            "mean something else to the model",
            next="set the dataset back; or begin another run from these weights: init_from = "
            "'<this checkpoint>' and another --work-dir",
        )


def _warnings(run: Strategy, checkpoint: Checkpoint, saved: Mapping[str, Any]) -> list[str]:
    """What to say of settings that may change, and have."""
    said = check_same_run(saved, run.plan, seeds_of(run.dataset), str(checkpoint.path))
    context = run.context
    changed = changed_settings(checkpoint.config(), context.config, context.section)
    listed = [f"    {key}: {before} -> {now}" for key, (before, now) in changed.items()]
    head = "other settings than those of the checkpoint's run:"
    return (["\n".join([head, *listed])] if listed else []) + ([said] if said else [])


def _shown(settings: Mapping[str, Any] | None) -> str:
    if settings is None:
        return "not set"
    named = ("r", "lora_alpha", "lora_dropout", "target_modules", "modules_to_save")
    return ", ".join(f"{key}={settings[key]}" for key in named)


def restore(run: Strategy, checkpoint: Checkpoint) -> None:
    """Put everything but the random generators back to where ``checkpoint`` was saved.

    Raises:
        CheckpointError: it is of another model, optimizer, dataset, seed or adapter, or one of
            the two keeps averages.
    """
    where = str(checkpoint.path)
    saved = checkpoint.json(TRAINER)
    check_same_adapter(run.lora, LoraOptions.of_checkpoint(checkpoint), where)
    check_same_averages(run.options.ema_decay, checkpoint)
    warnings = _warnings(run, checkpoint, saved)
    check_same_statistics(run.dataset, checkpoint)
    for warning in warnings if run.world.first else ():
        run.context.reporter.warn(warning)
    tensors = checkpoint.tensors(MODEL) | adapter_tensors(run.model, checkpoint)
    check_model_tensors(run.model, tensors, run.left_out or LeftOut(), saved["left_out"], where)
    run._load_model_state(tensors)
    optimizer = checkpoint.optimizer_tensors(), checkpoint.json(OPTIMIZER_META)
    if run._load_optimizer_tensors(*optimizer, where) is False:
        raise CheckpointError(
            f"{type(run).__name__} did not take the checkpoint's optimizer state", where=where
        )
    if run.ema is not None:
        run.ema.load(checkpoint.tensors(EMA), where)
    run.metric.load_state_dict(saved["metric"])
    run.progress = Progress.from_dict(saved)
    run.lr_scheduler.load_state_dict(_schedule_state(run, saved))


def _schedule_state(run: Strategy, saved: Mapping[str, Any]) -> Any:
    """Where the schedule goes on: of epochs, at the same sample if steps are larger or smaller now.

    The rate follows the part of the run that is done. A count of the old steps would be past the
    end of fewer, larger ones, and train the rest at a rate of 0.
    """
    same = saved["step_samples"] == run.plan.step_samples
    if same or not isinstance(run.lr_scheduler, ScheduledLR):
        return saved["scheduler"]
    return {"step": run.planned_step}


def restore_rng(world: World, checkpoint: Checkpoint | None, seed: int) -> None:
    """Give this rank the random states it was saved with, or fresh ones of its own.

    On another number of ranks than before there is none to go on with: each rank then draws from
    a state that follows from the seed, its rank and the step.
    """
    if checkpoint is None:
        seed_all(rank_seed(seed, world.rank))
        return
    seed_all(rank_seed(seed, world.rank, checkpoint.step))
    if checkpoint.json(TRAINER)["world_size"] == world.size:
        set_rng_state(checkpoint.tensors(rng_file(world.rank)))
