"""Resume a training: choose the checkpoint, check that the run fits it, load weights and states."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from fluxvla_core.build import RunContext
from fluxvla_core.checkpoints.checkpoint import (
    CONFIG,
    EMA,
    MODEL,
    TRAINER,
    Checkpoint,
    clear_leftovers,
    name_best,
    newest_undamaged,
    refuse_existing,
    set_aside_later,
)
from fluxvla_core.checkpoints.manifest import FOLDER, step_name
from fluxvla_core.contracts.training import Dataset
from fluxvla_core.data.sampler import StepPlan
from fluxvla_core.errors import CheckpointError
from fluxvla_core.training.distributed import World, all_reduce_max, run_on_rank0
from fluxvla_core.training.lora import LoraOptions, adapter_tensors
from fluxvla_core.training.saving import described_as_json, rng_file
from fluxvla_core.training.state import (
    Progress,
    SavedTrainer,
    rank_seed,
    seed_all,
    seeds_of,
    set_rng_state,
)
from fluxvla_core.training.weights import ExternalWeights, SavedWeights, check_model_tensors

AUTO = "auto"


def choose_checkpoint(
    world: World, context: RunContext, resume: str | None, first: str | None
) -> Checkpoint | None:
    """The verified checkpoint to resume from, None to start from scratch; the same on every rank.

    Also clears what killed saves left in the work dir, which is this run's own by now.

    Args:
        resume: ``auto`` (the newest undamaged one; a damaged newer one is named and passed over), a
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
    checkpoint, refused = newest_undamaged(context.work_dir)
    if checkpoint is None and refused:
        raise refused[0]
    for error in refused:
        context.reporter.warn(
            f"not resuming from a damaged checkpoint: {error.where}: {error.what}"
        )
    return checkpoint


def load_weights(
    checkpoint: Checkpoint, model: nn.Module, external: ExternalWeights | None
) -> dict[str, Tensor]:
    """The checkpoint's weights by name; all fit ``model``.

    Args:
        external: the frozen weights that the model's constructor loaded.

    Raises:
        CheckpointError: they are another model's, or other frozen weights go with them.
    """
    tensors = checkpoint.tensors(MODEL) | adapter_tensors(model, checkpoint)
    saved = checkpoint.json(TRAINER, SavedWeights)["left_out"]
    check_model_tensors(
        model, tensors, external or ExternalWeights(), saved, str(checkpoint.path), resuming=True
    )
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
    """Remove from ``progress`` the checkpoints that this work dir lacks.

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
    """Restore this rank's random states from the checkpoint, or seed new ones.

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


TABLES = ("model", "train_dataloader", "val_dataloader")
"""Tables of a config that decide about the result of a run, besides the section that runs."""
HARMLESS = frozenset(
    {
        # Where things are. A model's frozen weights are compared by their hash, data by statistics.
        *("init_from", "resume_from", "device"),
        # How samples are fetched.
        *("per_device_num_workers", "cache_frames"),
        # What is logged and saved, and how often.
        *("metric", "log_iter_interval", "peak_tflops", "val_iter_interval"),
        *("save_epoch_interval", "save_iter_interval", "max_keep_ckpts", "async_save"),
        "early_stop_patience",  # when it ends
        # Samples a step: what they come to together is compared on its own.
        *("per_device_batch_size", "grad_accumulation_steps"),
    }
)
"""Keys that may change without a warning."""
LENGTH = frozenset({"max_epochs", "max_steps"})
"""And those that may where the learning rate does not follow from them."""
_UNSET = "not set"


def check_settings(
    checkpoint: Checkpoint,
    context: RunContext,
    plan: StepPlan,
    dataset: Any,
    lora: LoraOptions | None,
    ema_decay: float | None,
) -> tuple[dict[str, Any], list[str]]:
    """Compare the present run with the one that saved ``checkpoint``.

    Returns:
        ``trainer.json``, and warnings about settings that may change, and have.

    Raises:
        CheckpointError: another dataset, seed or adapter, or one of the two keeps averages.
    """
    where = str(checkpoint.path)
    saved = checkpoint.json(TRAINER, SavedTrainer)
    check_same_adapter(lora, LoraOptions.of_checkpoint(checkpoint), where)
    check_same_averages(ema_decay, checkpoint)
    steps = check_same_run(saved, plan, seeds_of(dataset), where)
    changed = changed_settings(checkpoint.config(), context.config, context.section)
    check_same_statistics(dataset, checkpoint)
    listed = [f"    {key}: {before} -> {now}" for key, (before, now) in changed.items()]
    head = "other settings than those of the checkpoint's run:"
    return saved, (["\n".join([head, *listed])] if listed else []) + ([steps] if steps else [])


def check_same_run(
    saved: Mapping[str, Any], plan: StepPlan, seeds: Sequence[int | None], where: str
) -> str | None:
    """Refuse other data or another seed; a changed batch size or number of processes only warns.

    Args:
        saved: ``trainer.json``.
        seeds: what the dataset, and those it is made of, draw by.

    Returns:
        One line to warn with when steps will use other numbers of samples than before, or None.

    Raises:
        CheckpointError: another seed or number of samples, under which the order would change.
    """
    theirs = saved.get("data_seeds", seeds)
    for ours, before, what in (
        (plan.seed, saved.get("seed"), "seed"),
        (plan.length, saved.get("n_train_examples"), "number of samples in the dataset"),
        (plan.shuffle_episodes, saved.get("shuffle_episodes"), "value of shuffle_episodes"),
        (_listed(seeds), _listed(theirs), "seed of the dataset"),
    ):
        if before != ours:
            raise CheckpointError(
                f"the {what} is {ours}, the checkpoint's run had {before}",
                where=where,
                cause="the order of samples would change in the middle of an epoch",
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


def _begin_another(checkpoint: str) -> str:
    weights = shlex.quote(f"<section>.init_from={checkpoint}")
    return f"begin another run from these weights: --set {weights} --work-dir OTHER"


def check_same_adapter(ours: LoraOptions | None, theirs: LoraOptions | None, where: str) -> None:
    """Raise an error if the LoRA settings differ, or only one of the two runs uses LoRA.

    Raises:
        CheckpointError: says both.
    """
    mine, saved = ({} if o is None else _as_in_config(o) for o in (ours, theirs))
    changed = [key for key in saved or mine if mine.get(key) != saved.get(key)]
    if not changed:
        return
    if mine and saved:
        now, before = (_shown(values, changed) for values in (mine, saved))
        what = f"lora has {now}, the checkpoint's run had {before}"
    elif mine:
        what = "lora is set, the checkpoint's run had none"
    else:
        what = f"lora is not set, the checkpoint's run had {_shown(saved, ('rank', 'alpha'))}"
    raise CheckpointError(
        what,
        where=where,
        next=f"set it back as in the checkpoint's {CONFIG}; or {_begin_another(where)}",
    )


def _as_in_config(options: LoraOptions) -> dict[str, Any]:
    """The settings by their keys in a config; what may be left out there has its value."""
    alpha = options.rank if options.alpha is None else options.alpha
    values = vars(replace(options, alpha=alpha))
    return {k: list(v) or None if isinstance(v, tuple) else v for k, v in values.items()}


def _shown(settings: Mapping[str, Any], keys: Iterable[str]) -> str:
    return ", ".join(f"{key}={settings[key]}" for key in keys)


def check_same_averages(decay: float | None, checkpoint: Checkpoint) -> None:
    """Raise an error if only one of the two runs keeps averaged weights.

    Raises:
        CheckpointError: says which.
    """
    if (decay is not None) == checkpoint.has(EMA):
        return
    if decay is not None:
        what = "ema_decay is set, and the checkpoint's run kept no averaged weights"
        back = "resume without ema_decay"
    else:
        what = (
            "ema_decay is not set, and the checkpoint's run kept averaged weights, which are used "
            "for inference"
        )
        back = "set it back: the checkpoint's config.resolved.json has its value"
    raise CheckpointError(
        what,
        where=str(checkpoint.path),
        next=f"{back}; or {_begin_another(str(checkpoint.path))}",
    )


def check_same_statistics(dataset: Any, checkpoint: Checkpoint) -> None:
    """Raise an error if the dataset is normalised by other statistics.

    Raises:
        CheckpointError: names the statistics that differ.
    """
    ours = described_as_json(dict(Dataset.adapt(dataset).statistics or {}))
    changed = changed_statistics(checkpoint.statistics(), ours)
    if changed:
        named = ", ".join(changed[:6]) + (", …" if len(changed) > 6 else "")
        raise CheckpointError(
            f"the dataset's statistics are not those of the checkpoint's run: {named}",
            where=str(checkpoint.path),
            cause="other data, episodes or settings of the dataset: states and actions would now "
            "mean something else to the model",
            next=f"set the dataset back; or {_begin_another(str(checkpoint.path))}",
        )


def changed_settings(
    saved: Mapping[str, Any], ours: Mapping[str, Any], section: str
) -> dict[str, tuple[str, str]]:
    """Keys of the running ``section`` and of :data:`TABLES` that differ, and both values.

    Args:
        saved: the checkpoint's config tree.
        ours: the present one's.

    Returns:
        Dotted key -> (before, now), as JSON or ``not set``.
    """
    steady = all(_steady(tree[section]) for tree in (saved, ours) if section in tree)
    harmless = HARMLESS | LENGTH if steady else HARMLESS
    before, now = (
        {
            key: value
            for name in (section, *TABLES)
            for key, value in _leaves(name, described_as_json(tree.get(name) or {}), harmless)
        }
        for tree in (saved, ours)
    )
    return {
        key: (before.get(key, _UNSET), now.get(key, _UNSET))
        for key in {**before, **now}
        if before.get(key) != now.get(key)
    }


def _steady(runner: Mapping[str, Any]) -> bool:
    """Whether the learning rate of a step is the same however long the run is."""
    constant = runner.get("lr_scheduler_type", "constant") == "constant"
    return constant and not runner.get("warmup_ratio")


def _leaves(name: str, value: Any, harmless: Set[str]) -> Iterator[tuple[str, str]]:
    """Dotted keys below ``name`` with their values as text; lists of tables count from 0."""
    if isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
        value = {str(i): item for i, item in enumerate(value)}
    if not isinstance(value, Mapping):
        yield name, json.dumps(value, ensure_ascii=False)
        return
    for key, item in value.items():
        if key not in harmless and not key.endswith("_path"):
            yield from _leaves(f"{name}.{key}", item, harmless)


def changed_statistics(saved: Any, present: Any, name: str = "") -> list[str]:
    """Dotted names of statistics that differ by more than another machine's rounding does."""
    if isinstance(saved, Mapping) and isinstance(present, Mapping):
        return [
            change
            for key in {**saved, **present}
            for change in changed_statistics(
                saved.get(key), present.get(key), f"{name}.{key}".strip(".")
            )
        ]
    if isinstance(saved, list) and isinstance(present, list) and len(saved) == len(present):
        pairs = zip(saved, present, strict=True)
        return [name] if any(changed_statistics(a, b, name) for a, b in pairs) else []
    numbers = all(isinstance(v, int | float) for v in (saved, present))
    same = math.isclose(saved, present, rel_tol=1e-5, abs_tol=1e-8) if numbers else saved == present
    return [] if same else [name]
