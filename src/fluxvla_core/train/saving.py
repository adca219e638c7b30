"""What goes into a checkpoint, and how the ranks write it together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor, nn

from fluxvla_core.build import RunContext
from fluxvla_core.checkpoints import checkpoint as ckpt
from fluxvla_core.checkpoints.parts import is_split, own_parts
from fluxvla_core.checkpoints.shelf import rotate
from fluxvla_core.checkpoints.tensors import TensorFile
from fluxvla_core.checkpoints.writer import CheckpointWriter, json_bytes
from fluxvla_core.config.load import FORMAT
from fluxvla_core.config.resolved import environment
from fluxvla_core.train import lora
from fluxvla_core.train.changes import plain
from fluxvla_core.train.distributed import World, on_first, texts
from fluxvla_core.train.ema import Ema
from fluxvla_core.train.saver import Saver
from fluxvla_core.train.state import rng_state, seeds_of
from fluxvla_core.train.weights import LeftOut

if TYPE_CHECKING:
    from fluxvla_core.train.strategy import Strategy


@dataclass(frozen=True)
class Snapshot:
    """One moment of a run: the tensors as they are in memory, everything else as JSON values.

    Args:
        model: weights and buffers of the model's file.
        optimizer: its state by ``<parameter>/<key>``.
        described: ``optimizer.json``.
        trainer: ``trainer.json``.
        adapter: what LoRA trains, by peft's names; it is not among the model's file.
        documents: file name -> JSON object, fixed for the run.
        folders: folder name -> what fills it.
    """

    model: Mapping[str, Tensor]
    optimizer: Mapping[str, Tensor]
    described: Mapping[str, Any]
    trainer: Mapping[str, Any]
    ema: Ema | None = None
    adapter: Mapping[str, Tensor] = field(default_factory=dict)
    documents: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    folders: Mapping[str, Callable[[Path], Any]] = field(default_factory=dict)


def save_snapshot(
    saver: Saver,
    work_dir: Path,
    step: int,
    epoch: int,
    snapshot: Snapshot,
    keep: int,
    spare: int | None = None,
) -> Path:
    """Begin the checkpoint of ``step``; ``saver.settle`` tells when it is there.

    Every rank calls this. When it is there all but the ``keep`` newest are removed (0 keeps all),
    but for that of step ``spare``; old ones that cannot be removed are only warned of.

    Returns:
        The folder that it will be.

    Raises:
        RunFailed: the state of the scheduler or metric is not JSON.
    """
    world = saver.world
    writer = CheckpointWriter(work_dir, step, epoch, rank=world.rank)
    tensors = snapshot.optimizer
    split = any(map(is_split, tensors.values()))
    values = {ckpt.OPTIMIZER_META: snapshot.described, ckpt.TRAINER: snapshot.trainer}
    documents: dict[str, bytes] = {}

    def prepare() -> str:
        for name, value in {**values, **snapshot.documents}.items():
            documents[name] = json_bytes(name, value)
        writer.begin(ckpt.RANDOM, *([ckpt.OPTIMIZER_PARTS] if split else []))
        # Now rather than in the thread: the training may use the same tokenizer meanwhile.
        for name, fill in snapshot.folders.items():
            writer.fill_folder(name, fill)
        return ""

    on_first(world, prepare)
    files = [
        *_model_files(saver, snapshot),
        TensorFile.whole(rng_file(world.rank), rng_state(), True),
    ]
    if split:
        parts = own_parts(tensors, world.first)
        if parts:
            files.append(TensorFile.parts(part_file(world.rank), parts))
    else:
        files.append(TensorFile.whole(ckpt.OPTIMIZER, tensors, world.first))

    def write(group: World, held: Iterable[TensorFile], warn: Callable[[str], None]) -> Path:
        try:
            for file in held:
                file.write(writer)
        except Exception as error:  # noqa: BLE001 - the other ranks wait to hear of it
            writer.refuse(error)
        reports = texts(group, writer.report())

        def finish() -> str:
            writer.join(reports)
            for name, data in documents.items():
                writer.write_bytes(name, data)
            for name in snapshot.folders:
                writer.enter_folder(name)
            path = writer.commit()
            try:
                rotate(work_dir, keep, spare=spare)
            except OSError as error:
                warn(f"old checkpoints could not be removed: {error}")
            return str(path)

        return Path(on_first(group, finish))

    saver.start(step, files, write)
    return writer.final


def _model_files(saver: Saver, snapshot: Snapshot) -> list[TensorFile]:
    model = snapshot.model
    if saver.beside:
        # The next forward pass may change buffers, while weights stay until the optimizer's step.
        copies = {id(t): t.clone() for t in model.values() if not isinstance(t, nn.Parameter)}
        model = {name: copies.get(id(t), t) for name, t in model.items()}
    first = saver.world.first
    files = [TensorFile.whole(ckpt.MODEL, model, first)]
    if snapshot.adapter:
        files.append(TensorFile.whole(lora.WEIGHTS, snapshot.adapter, first))
    if snapshot.ema is not None:
        files.append(TensorFile.whole(ckpt.EMA, snapshot.ema.shadow, first))
    return files


def rng_file(rank: int) -> str:
    """Name of a rank's file of random states."""
    return f"{ckpt.RANDOM}/rank-{rank:05d}.safetensors"


def part_file(rank: int) -> str:
    """Name of a rank's file with its parts of the optimizer's state."""
    return f"{ckpt.OPTIMIZER_PARTS}/rank-{rank:05d}.safetensors"


def take_snapshot(run: Strategy, train_loss: float | None, only_trainable: bool) -> Snapshot:
    """The runner's present moment.

    Args:
        only_trainable: leave out frozen weights that the model brings itself.
    """
    without = run.left_out if only_trainable and run.left_out is not None else LeftOut()
    state, (optimizer, described) = run._model_tensors(), run._optimizer_tensors()
    adapter = lora.adapter_names(run.model)
    elsewhere = {*without.names, *adapter}
    documents = run_documents(run.context, run.dataset, run.model) if run.world.first else {}
    if run.lora is not None:
        documents[lora.CONFIG] = run.lora.for_peft(run.adapter_base)
    trainer = {
        **run.progress.to_dict(),
        "train_loss": train_loss,
        "scheduler": run.lr_scheduler.state_dict(),
        "metric": run.metric.state_dict(),
        "seed": run.plan.seed,
        "data_seeds": seeds_of(run.dataset),
        "n_train_examples": run.plan.length,
        "step_samples": run.plan.step_samples,
        "world_size": run.plan.world,
        "shuffle_episodes": run.loader_options.shuffle_episodes,
        "left_out": without.to_dict(),
    }
    return Snapshot(
        {name: tensor for name, tensor in state.items() if name not in elsewhere},
        optimizer,
        described,
        trainer,
        run.ema,
        {theirs: state[name] for name, theirs in adapter.items()},
        documents,
        run_folders(run.dataset, run.tokenizer),
    )


def run_documents(context: RunContext, dataset: Any, model: nn.Module) -> dict[str, dict[str, Any]]:
    """The JSON files that are the same in every checkpoint of a run.

    ``policy.json``: ``action_rate_hz`` is the dataset's ``fps`` (Hz), ``horizon`` the first of
    the model's ``action_shape``, else the dataset's ``action_window_size``; null where unknown.
    """
    shape = getattr(model, "action_shape", None)
    horizon = shape[0] if shape else getattr(dataset, "action_window_size", None)
    rate = getattr(dataset, "fps", None)
    config = {"format": FORMAT, "config": context.config, "origins": dict(context.origins)}
    documents: dict[str, dict[str, Any]] = {
        ckpt.CONFIG: plain(config),
        ckpt.ENVIRONMENT: environment(),
        ckpt.POLICY: {
            "action_rate_hz": None if rate is None else float(rate),
            "horizon": None if horizon is None else int(horizon),
        },
        ckpt.STATISTICS: dict(getattr(dataset, "statistics", None) or {}),
    }
    embodiment = getattr(dataset, "embodiment", None)
    if embodiment is not None:
        documents[ckpt.EMBODIMENT] = embodiment.to_dict()
    return documents


def run_folders(dataset: Any, tokenizer: Any) -> dict[str, Callable[[Path], Any]]:
    """What fills the checkpoint's ``processors``: the dataset's pipeline, else the tokenizer."""
    for owner in (getattr(dataset, "pipeline", None), getattr(dataset, "transforms", None)):
        save = getattr(owner, "save_pretrained", None)
        if save is not None:
            return {ckpt.PROCESSORS: save}
    save = getattr(tokenizer, "save_pretrained", None)
    if save is None:
        return {}
    return {ckpt.PROCESSORS: lambda folder: save(folder / "tokenizer")}
