"""Save checkpoints asynchronously: what goes in, and how the ranks write it together."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from fluxvla_core.build import RunContext
from fluxvla_core.checkpoints import checkpoint as ckpt
from fluxvla_core.checkpoints.checkpoint import rotate
from fluxvla_core.checkpoints.shards import is_sharded, local_shards
from fluxvla_core.checkpoints.tensors import TensorFile
from fluxvla_core.checkpoints.writer import CheckpointWriter, json_bytes
from fluxvla_core.config.load import FORMAT, environment
from fluxvla_core.contracts.training import VLA, Dataset
from fluxvla_core.training import lora
from fluxvla_core.training.distributed import World, all_gather_text, all_reduce_max, run_on_rank0
from fluxvla_core.training.state import Ema, rng_state

_ADDRESS = re.compile(r" at 0x[0-9a-f]+")


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
    spare: int | None,
) -> Path:
    """Begin the checkpoint of ``step``; ``saver.finish_pending`` says when it is complete.

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
    sharded = any(map(is_sharded, tensors.values()))
    values = {ckpt.OPTIMIZER_META: snapshot.described, ckpt.TRAINER: snapshot.trainer}
    documents: dict[str, bytes] = {}

    def prepare() -> str:
        for name, value in {**values, **snapshot.documents}.items():
            documents[name] = json_bytes(name, value)
        writer.begin(ckpt.RANDOM, *([ckpt.OPTIMIZER_SHARDS] if sharded else []))
        # Now rather than in the thread: the training may use the same tokenizer meanwhile.
        for name, fill in snapshot.folders.items():
            writer.write_folder(name, fill)
        return ""

    run_on_rank0(world, prepare)
    files = [
        *_model_files(saver, snapshot),
        TensorFile.full(rng_file(world.rank), rng_state(), True),
    ]
    if sharded:
        shards = local_shards(tensors, world.is_rank0)
        if shards:
            name = f"{ckpt.OPTIMIZER_SHARDS}/rank-{world.rank:05d}.safetensors"
            files.append(TensorFile.shards(name, shards))
    else:
        files.append(TensorFile.full(ckpt.OPTIMIZER, tensors, world.is_rank0))

    def write(group: World, held: Iterable[TensorFile], warn: Callable[[str], None]) -> None:
        try:
            for file in held:
                file.write(writer)
        except Exception as error:  # noqa: BLE001 - the other ranks wait to hear of it
            writer.set_error(error)
        reports = all_gather_text(group, writer.rank_report())

        def finish() -> str:
            writer.merge_reports(reports)
            for name, data in documents.items():
                writer.write_bytes(name, data)
            for name in snapshot.folders:
                writer.add_folder(name)
            writer.commit()
            try:
                rotate(work_dir, keep, spare=spare)
            except OSError as error:
                warn(f"old checkpoints could not be removed: {error}")
            return ""

        run_on_rank0(group, finish)

    saver.start(Save(step, writer.final), files, write)
    return writer.final


def _model_files(saver: Saver, snapshot: Snapshot) -> list[TensorFile]:
    model = snapshot.model
    if saver.background:
        # The next forward pass may change buffers, while weights stay until the optimizer's step.
        copies = {id(t): t.clone() for t in model.values() if not isinstance(t, nn.Parameter)}
        model = {name: copies.get(id(t), t) for name, t in model.items()}
    first = saver.world.is_rank0
    files = [TensorFile.full(ckpt.MODEL, model, first)]
    if snapshot.adapter:
        files.append(TensorFile.full(lora.WEIGHTS, snapshot.adapter, first))
    if snapshot.ema is not None:
        files.append(TensorFile.full(ckpt.EMA, snapshot.ema.shadow, first))
    return files


def rng_file(rank: int) -> str:
    """Name of a rank's file of random states."""
    return f"{ckpt.RANDOM}/rank-{rank:05d}.safetensors"


def run_documents(context: RunContext, dataset: Any, model: nn.Module) -> dict[str, dict[str, Any]]:
    """The JSON files that are the same in every checkpoint of a run.

    ``policy.json``: ``action_rate_hz`` is the dataset's ``fps`` (Hz), ``horizon`` the first of
    the model's ``action_shape``, else the dataset's ``action_window_size``; null where unknown.
    """
    described = Dataset.adapt(dataset)
    vla = VLA.adapt(model)
    horizon = vla.action_shape[0] if vla.action_shape else described.action_window_size
    rate = described.fps
    tree = dict(context.config)
    if isinstance(tree.get("model"), Mapping):
        tree["model"] = vla.checkpoint_table(tree["model"])
    config = {"format": FORMAT, "config": tree, "origins": dict(context.origins)}
    documents: dict[str, dict[str, Any]] = {
        ckpt.CONFIG: described_as_json(config),
        ckpt.ENVIRONMENT: environment(),
        ckpt.POLICY: {
            "action_rate_hz": None if rate is None else float(rate),
            "horizon": None if horizon is None else int(horizon),
        },
        ckpt.STATISTICS: dict(described.statistics or {}),
    }
    embodiment = described.embodiment
    if embodiment is not None:
        documents[ckpt.EMBODIMENT] = embodiment.to_dict()
    return documents


def described_as_json(config: Any) -> Any:
    """``config`` as JSON values; objects, which one made in Python may hold, are described."""
    return json.loads(json.dumps(config, default=_described))


def _described(value: Any) -> str:
    """``repr`` without the memory address, which differs between processes."""
    return _ADDRESS.sub("", repr(value))


def run_folders(dataset: Any, tokenizer: Any) -> dict[str, Callable[[Path], Any]]:
    """Content of the checkpoint's ``processors``: the dataset's pipeline, else the tokenizer."""
    for owner in (getattr(dataset, "pipeline", None), getattr(dataset, "transforms", None)):
        save = getattr(owner, "save_pretrained", None)
        if save is not None:
            return {ckpt.PROCESSORS: save}
    save = getattr(tokenizer, "save_pretrained", None)
    if save is None:
        return {}
    return {ckpt.PROCESSORS: lambda folder: save(folder / "tokenizer")}


@dataclass
class Save:
    """A checkpoint being written; once it is complete, ``path`` is its folder.

    ``copied`` is set as soon as the training may change its tensors.
    """

    step: int
    path: Path
    copied: threading.Event = field(default_factory=threading.Event)
    warnings: list[str] = field(default_factory=list)
    error: BaseException | None = None
    thread: threading.Thread | None = None


class Saver:
    """Writes checkpoints of one run, in a background thread or at once.

    Args:
        world: the processes that save together.
        background: write in a thread, from copies of the tensors.
        optimizer: waits, in its ``step``, for the copy; one without ``register_step_pre_hook``
            is copied before :meth:`start` returns.
    """

    def __init__(self, world: World, background: bool, optimizer: Any = None) -> None:
        self.world, self.background = world, background
        self._threads = world
        if background and world.size > 1:
            # The threads of all ranks talk while the training talks on the other groups.
            self._threads = replace(world, control=dist.new_group(backend="gloo"))
        self._save: Save | None = None
        self._memory: dict[tuple[str, int], Tensor] = {}
        self._before_step = getattr(optimizer, "register_step_pre_hook", None)
        self._hook: Any = None

    def start(
        self,
        save: Save,
        files: Sequence[TensorFile],
        write: Callable[[World, Iterable[TensorFile], Callable[[str], None]], None],
    ) -> None:
        """Start a save: ``write(world, files, warn)`` makes the checkpoint; all ranks call it.

        The one before must have been finished with :meth:`finish_pending`.
        """
        self._save = save
        warn = save.warnings.append
        if not self.background:
            self._run(save, lambda: write(self.world, files, warn))
            return
        gathered = [file.gathered(partial(self._host_copy, file.name)) for file in files]
        stream = _copy_stream(self.world.device)
        save.thread = threading.Thread(
            target=self._run,
            args=(
                save,
                lambda: write(self._threads, self._host_copies(save, gathered, stream), warn),
            ),
            name=f"checkpoint-{save.step}",
            daemon=True,
        )
        save.thread.start()
        if self._before_step is None:
            self.wait_for_copies()
        else:
            # Only while there is something to wait for: each hook costs every step its time.
            self._hook = self._before_step(lambda *_: self.wait_for_copies())

    def wait_for_copies(self) -> None:
        """Wait until weights and optimizer may change. The optimizer's step does so by itself."""
        if self._save is not None and self._save.thread is not None:
            self._save.copied.wait()

    def finish_pending(self, wait: bool) -> Save | None:
        """Finish the pending save, if there is one; all ranks call it at the same step.

        Args:
            wait: for its end; otherwise None is returned while some rank still writes.

        Raises:
            RunFailed: it could not be saved.
        """
        save = self._save
        if save is None:
            return None
        if save.thread is not None:
            if not wait and all_reduce_max(self.world, int(save.thread.is_alive())):
                return None
            save.thread.join()
        if self._hook is not None:
            self._hook.remove()
        self._save = self._hook = None
        if save.error is not None:
            raise save.error
        return save

    def close(self) -> None:
        """Wait for the pending save, whether it succeeds or not."""
        if self._save is not None and self._save.thread is not None:
            self._save.thread.join()

    def _run(self, save: Save, work: Callable[[], None]) -> None:
        try:
            work()
        except BaseException as error:  # noqa: BLE001 - finish_pending raises it
            save.error = error

    def _host_copies(
        self, save: Save, files: Sequence[TensorFile], stream: AbstractContextManager[object]
    ) -> Iterator[TensorFile]:
        """Copies of ``files``; all are made before the first is written."""
        try:
            with stream:
                held = []
                for file in files:
                    copies = (self._host_copy(file.name, i, t) for i, t in enumerate(file.tensors))
                    held.append(replace(file, tensors=tuple(copies)))
        finally:
            save.copied.set()
        yield from held

    def _host_copy(self, file: str, index: int, tensor: Tensor) -> Tensor:
        """``tensor`` in a host buffer that is reused by every save, pinned if it is on a GPU."""
        buffer = self._memory.get((file, index))
        if buffer is None or buffer.shape != tensor.shape or buffer.dtype != tensor.dtype:
            buffer = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=tensor.is_cuda)
            self._memory[file, index] = buffer
        if buffer is tensor:
            return buffer
        with torch.no_grad():
            return buffer.copy_(tensor)


def _copy_stream(device: torch.device) -> AbstractContextManager[object]:
    """Context manager: CUDA stream for the copies, which waits for all work enqueued so far."""
    if device.type != "cuda":
        return nullcontext()
    stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
    stream.wait_stream(torch.cuda.current_stream(device))
    return torch.cuda.stream(stream)
