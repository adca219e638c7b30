"""``FSDPTrainRunner``: every process holds a part of the model and gathers a block at a time."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, ClassVar

from fluxvla_core.errors import ConfigError
from fluxvla_core.training import BaseTrainRunner

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn
    from torch.distributed.device_mesh import DeviceMesh

    from fluxvla_core.training import Layout

STRATEGIES = ("full-shard", "shard-grad-op", "hybrid-shard", "no-shard")


class FSDPTrainRunner(BaseTrainRunner):
    """Fully sharded data-parallel training with torch's ``fully_shard`` (FSDP2).

    The blocks of the model's ``fsdp_units()`` are gathered one by one, those in a tuple together;
    frozen parameters and buffers stay whole on every process. In mixed precision blocks are
    gathered in bf16, which halves the traffic, but for batch and instance norms, whose running
    statistics are fp32; gradients are reduced in fp32.

    Args:
        sharding_strategy: ``full-shard``; ``shard-grad-op`` (weights stay gathered from the
            forward to the backward pass); ``hybrid-shard`` (split inside a machine, copied
            between machines); ``no-shard`` (copied everywhere).
        kwargs: the settings of ``BaseTrainRunner``.

    Raises:
        ConfigError: an unknown strategy; later, in ``run_setup``, a weight in two units, or a
            trained parameter without dimensions.
    """

    api: ClassVar[str] = "1.0"
    needs_process_group: ClassVar[bool] = True

    def __init__(self, *, sharding_strategy: str = "full-shard", **kwargs: Any) -> None:
        super().__init__(**kwargs)
        if sharding_strategy not in STRATEGIES:
            raise ConfigError(
                f"unknown sharding_strategy {sharding_strategy!r}; choose one of "
                f"{', '.join(map(repr, STRATEGIES))}",
                where=self.context.where(f"{self.context.section}.sharding_strategy"),
            )
        self.sharding_strategy = sharding_strategy

    def _wrap_model(self, vla: nn.Module) -> nn.Module:
        """Split the model's units, then what is left of it, over the mesh."""
        from torch.distributed.fsdp import fully_shard

        from fluxvla_core.training import refuse_scalars, trainable
        from fluxvla_fsdp.groups import check_ties, groups_of

        refuse_scalars(trainable(vla), type(self).__name__, self.context.where("model"))
        check_ties(vla, self.context.where("model"))
        frozen = {p for p in vla.parameters() if not p.requires_grad}
        shared: dict[str, Any] = {"mesh": self._mesh(), "ignored_params": frozen}
        compute, fp32 = self._precision(self.compute_dtype), self._precision(None)
        for group in groups_of(vla, self._reshards, self.compute_dtype, self.world.device.type):
            fully_shard(
                list(group.modules),
                mp_policy=compute if group.lowered else fp32,
                reshard_after_forward=group.reshards,
                **shared,
            )
        # What is split was moved unit by unit: the whole model need not fit one device.
        for parameter in frozen:
            parameter.data = parameter.data.to(self.world.device)
        return vla

    @property
    def _reshards(self) -> bool:
        """Whether a unit's weights are let go of between the forward and the backward pass."""
        return self.sharding_strategy in ("full-shard", "hybrid-shard")

    def memory_layout(self, model: nn.Module, processes: int, device_type: str) -> Layout:
        """Shards of what is trained; frozen weights and buffers are whole."""
        from fluxvla_fsdp.groups import groups_of
        from fluxvla_fsdp.layout import sharded

        groups = groups_of(model, self._reshards, self.compute_dtype, device_type)
        parts = 1 if self.sharding_strategy == "no-shard" else processes
        accumulates = self.options.grad_accumulation_steps > 1
        return sharded(model, groups, parts, self.compute_dtype, accumulates)

    def _mesh(self) -> DeviceMesh:
        """One dimension to split over, or (copies, parts) for the strategies that copy."""
        from torch.distributed.device_mesh import init_device_mesh

        size, kind = self.world.size, self.world.device.type
        if self.sharding_strategy in ("full-shard", "shard-grad-op"):
            return init_device_mesh(kind, (size,), mesh_dim_names=("shard",))
        parts = 1
        if self.sharding_strategy == "hybrid-shard":
            parts = int(os.environ.get("LOCAL_WORLD_SIZE", str(size)))
            if size % parts:
                raise ConfigError(
                    f"hybrid-shard needs as many processes on every machine: {size} are not a "
                    f"multiple of {parts}"
                )
        return init_device_mesh(kind, (size // parts, parts), mesh_dim_names=("copy", "shard"))

    def _precision(self, dtype: torch.dtype | None) -> Any:
        """The policy of a group whose weights are gathered in ``dtype``."""
        import torch
        from torch.distributed.fsdp import MixedPrecisionPolicy

        # Inputs keep their dtype: casting them would round targets and states as well.
        return MixedPrecisionPolicy(
            param_dtype=dtype,
            reduce_dtype=torch.float32 if dtype else None,
            cast_forward_inputs=False,
        )

    def sync_gradients(self, last: bool) -> AbstractContextManager[object]:
        self.vla.set_requires_gradient_sync(last)
        return super().sync_gradients(last)

    def optimizer_step(self) -> Tensor | None:
        from fluxvla_core.training import broadcast_buffers

        norm = super().optimizer_step()
        # fully_shard leaves buffers to every process.
        broadcast_buffers(self.world, self.model)
        return norm
