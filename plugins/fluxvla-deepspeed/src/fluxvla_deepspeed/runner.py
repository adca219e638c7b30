"""``DeepSpeedTrainRunner``: ZeRO splits optimizer state, gradients and weights."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, ClassVar

from fluxvla_core.errors import CheckpointError, ConfigError
from fluxvla_core.training import BaseTrainRunner

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

    from fluxvla_core.training import Layout, Stored


class DeepSpeedTrainRunner(BaseTrainRunner):
    """Training with DeepSpeed's ZeRO, on GPUs over NCCL and on CPUs over gloo.

    Checkpoints are those of every other strategy: full tensors by parameter name, which another
    runner, or another number of processes, can go on from.

    Args:
        zero_stage: what is split over the processes: 1 the optimizer's state, 2 gradients too,
            3 weights too.
        kwargs: the settings of ``BaseTrainRunner``.

    Raises:
        ConfigError: an unknown stage, averages with stage 3, or DeepSpeed is not installed; later,
            in ``run_setup``, a parameter without dimensions.
    """

    api: ClassVar[str] = "1.0"
    needs_process_group: ClassVar[bool] = True

    def __init__(self, *, zero_stage: int = 2, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if zero_stage not in (1, 2, 3) or isinstance(zero_stage, bool):
            raise ConfigError(
                f"zero_stage must be 1, 2 or 3, got {zero_stage!r}",
                where=self.context.where(f"{self.context.section}.zero_stage"),
            )
        if zero_stage == 3 and self.options.ema_decay is not None:
            raise ConfigError(
                "ema_decay does not go together with zero_stage 3",
                where=self.context.where(f"{self.context.section}.ema_decay"),
                cause="no process holds full weights between steps to average",
                next="use zero_stage 2, or FSDPTrainRunner, which averages its parts",
            )
        if find_spec("deepspeed") is None:
            raise ConfigError(
                "DeepSpeedTrainRunner needs the package deepspeed, which is not installed",
                where=self.context.where(f"{self.context.section}.type"),
                next="pip install 'fluxvla-deepspeed[deepspeed]'",
            )
        self.zero_stage = zero_stage
        self._groups: list[list[str]] = []

    def _wrap_model(self, vla: nn.Module) -> nn.Module:
        """Move the model to its device; the engine is made together with the optimizer."""
        from fluxvla_core.training import refuse_scalars

        # DeepSpeed views every parameter as bytes, frozen ones as well, which these do not allow.
        named = dict(vla.named_parameters())
        refuse_scalars(named, type(self).__name__, self.context.where("model"))
        return vla.to(self.world.device)

    def memory_layout(self, model: nn.Module, processes: int, device_type: str) -> Layout:
        from fluxvla_deepspeed.layout import partitioned

        return partitioned(model, self.zero_stage, processes)

    def unwrap_model(self, vla: nn.Module) -> nn.Module:
        inside: nn.Module = getattr(vla, "module", vla)
        return inside

    def _build_optimizer(self) -> torch.optim.Optimizer:
        """The config's optimizer; from here on its groups hold ZeRO's flat parts."""
        from fluxvla_core.training import external_weights
        from fluxvla_deepspeed.engine import start

        inner = super()._build_optimizer()
        model = self.model
        names = {id(p): name for name, p in model.named_parameters()}
        self._groups = [[names[id(p)] for p in g["params"]] for g in inner.param_groups]
        # Stage 3 splits frozen weights as well: so they are hashed before that.
        self.external_weights = external_weights(model)
        self.vla = start(
            model, inner, self.zero_stage, self.max_grad_norm, self.compute_dtype, self.world
        )
        return inner

    def sync_gradients(self, last: bool) -> AbstractContextManager[object]:
        self.vla.set_gradient_accumulation_boundary(last)
        return super().sync_gradients(last)

    def backward(self, loss: Tensor) -> None:
        self.vla.backward(loss, scale_wrt_gas=False)

    def optimizer_step(self) -> Tensor | None:
        """Let the engine clip and step; the gradients' norm before clipping.

        The engine has it with and without clipping, and leaves out a step whose norm is not finite.
        """
        import torch

        from fluxvla_core.training import broadcast_buffers

        self.vla.step()
        # DeepSpeed leaves buffers to every process.
        broadcast_buffers(self.world, self.model)
        return torch.as_tensor(self.vla.get_global_grad_norm(), device=self.world.device).float()

    def _trained(self) -> dict[str, nn.Parameter]:
        from fluxvla_core.training import trainable

        return trainable(self.model)

    def model_tensors(self) -> Mapping[str, Tensor]:
        """Whole weights and buffers; with stage 3 gathered, and kept by the first rank only."""
        from fluxvla_deepspeed.engine import gathered, on_host

        if self.zero_stage < 3:
            return super().model_tensors()
        with gathered(self.model.parameters(), self.zero_stage):
            state = super().model_tensors()
            return {name: on_host(tensor, self.world.is_rank0) for name, tensor in state.items()}

    def optimizer_tensors(self) -> tuple[Mapping[str, Tensor], dict[str, Any]]:
        from fluxvla_deepspeed.engine import read_state

        tensors = read_state(self.vla, self.optimizer, self._trained(), self.world.is_rank0)
        groups = [
            {**{k: v for k, v in group.items() if k != "params"}, "params": names}
            for group, names in zip(self.optimizer.param_groups, self._groups, strict=True)
        ]
        described = {"type": type(self.optimizer).__name__, "groups": groups, "scalars": {}}
        return tensors, described

    def _load_model_state(self, state: Mapping[str, Tensor]) -> None:
        from fluxvla_deepspeed.engine import put_master_weights

        super()._load_model_state(state)
        put_master_weights(self._trained(), state)

    def load_optimizer_tensors(
        self, tensors: Mapping[str, Tensor | Stored], described: Mapping[str, Any], where: str
    ) -> bool:
        from fluxvla_deepspeed.engine import put_state

        theirs = [group["params"] for group in described["groups"]]
        if described["type"] != type(self.optimizer).__name__ or theirs != self._groups:
            raise CheckpointError(
                f"the optimizer of the checkpoint ({described['type']}, groups of "
                f"{[len(g) for g in theirs]} parameters) is not this run's "
                f"({type(self.optimizer).__name__}, {[len(g) for g in self._groups]})",
                where=where,
                cause="the model or the optimizer settings of the config have changed",
                next="resume with the config that made it: config.resolved.json in its folder",
            )
        put_state(self.vla, self.optimizer, self._trained(), tensors)
        return True

    def resume(self) -> int:
        """Resume from the chosen checkpoint; the step it was saved at, 0 for a fresh start."""
        from fluxvla_deepspeed.engine import gathered

        with gathered(self.model.parameters(), self.zero_stage):
            return super().resume()
