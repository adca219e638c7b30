"""A train runner as the modules of this room see it."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

    from fluxvla_core.build import RunContext
    from fluxvla_core.checkpoints.checkpoint import Checkpoint
    from fluxvla_core.checkpoints.parts import Stored
    from fluxvla_core.data.order import EpisodeShards
    from fluxvla_core.hooks import HookCaller
    from fluxvla_core.train.batches import StepPlan
    from fluxvla_core.train.distributed import World
    from fluxvla_core.train.ema import Ema
    from fluxvla_core.train.flops import Meter
    from fluxvla_core.train.forward import ForwardArguments
    from fluxvla_core.train.lora import LoraOptions
    from fluxvla_core.train.options import LoaderOptions, TrainOptions
    from fluxvla_core.train.progress import Progress
    from fluxvla_core.train.saver import Saver
    from fluxvla_core.train.weights import LeftOut


class Strategy(Protocol):
    """The parts of ``BaseTrainRunner`` that loop, saving and resuming work with."""

    options: TrainOptions
    loader_options: LoaderOptions
    collator: Any
    vla: Any
    context: RunContext
    optimizer: torch.optim.Optimizer
    lr_scheduler: Any
    plan: StepPlan
    progress: Progress
    ema: Ema | None
    left_out: LeftOut | None
    adapter_base: str | None
    lora: LoraOptions | None
    flops: Meter | None
    sample_losses: Tensor | None
    val_options: LoaderOptions | None
    dataset: Any
    tokenizer: Any
    metric: Any
    hooks: HookCaller
    _arguments: ForwardArguments | None
    _checkpoint: Checkpoint | None
    _saver: Saver | None

    @property
    def world(self) -> World: ...
    @property
    def model(self) -> nn.Module: ...
    @property
    def total_steps(self) -> int: ...
    @property
    def planned_step(self) -> int: ...
    def _load_model_state(self, state: Mapping[str, Tensor]) -> None: ...
    def _model_tensors(self) -> Mapping[str, Tensor]: ...
    def _optimizer_tensors(self) -> tuple[Mapping[str, Tensor], dict[str, Any]]: ...
    def _load_optimizer_tensors(
        self, tensors: Mapping[str, Tensor | Stored], described: Mapping[str, Any], where: str
    ) -> bool: ...
    def _plan(self, samples: int, shards: EpisodeShards | None = None) -> StepPlan: ...
    def _shards(self, dataset: Any) -> EpisodeShards | None: ...
    def resume(self) -> int: ...
    def _training_step(self, batch: dict[str, Any]) -> Tensor: ...
    def _sync_gradients(self, last: bool) -> AbstractContextManager[object]: ...
    def _backward(self, loss: Tensor) -> None: ...
    def _update(self) -> Tensor | None: ...
    def _warm_up(self, batch: dict[str, Any]) -> None: ...
    def save_checkpoint(
        self, run_dir: Path, global_step: int, epoch: int, train_loss: float | None = None
    ) -> Any: ...
    def settle_saves(self, wait: bool = True) -> None: ...
