"""``DDPTrainRunner``: a copy of the model on every process, gradients averaged between them."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, ClassVar

from fluxvla_core.errors import ConfigError
from fluxvla_core.training import BaseTrainRunner

if TYPE_CHECKING:
    from torch import nn

    from fluxvla_core.training import Layout


class DDPTrainRunner(BaseTrainRunner):
    """Data-parallel training; on one process it is ``BaseTrainRunner``.

    Args:
        find_unused_parameters: for models whose forward pass leaves out trainable parameters;
            costs a walk over the graph in every step.
        static_graph: whether every step uses the same parameters in the same order; gradients are
            then exchanged as the first step showed, which also suits parameters that are used
            several times, or recomputed. By default what the model says (``static_graph``), and
            no without it.
        kwargs: the settings of ``BaseTrainRunner``.
    """

    api: ClassVar[str] = "1.0"

    def __init__(
        self,
        *,
        find_unused_parameters: bool = False,
        static_graph: bool | None = None,
        **kwargs: Any,
    ) -> None:
        if find_unused_parameters and static_graph:
            raise ConfigError(
                "find_unused_parameters and static_graph exclude each other",
                cause="parameters are looked for because steps differ; a static graph never does",
                next="keep find_unused_parameters for models that leave out other parameters "
                "each step, static_graph for those that leave out the same ones",
            )
        super().__init__(**kwargs)
        self.find_unused_parameters = find_unused_parameters
        self.static_graph = static_graph

    def _wrap_model(self, vla: nn.Module) -> nn.Module:
        """Move the model to its device and keep its copies equal from there on."""
        from torch.nn.parallel import DistributedDataParallel

        from fluxvla_core.training import VLA

        device = self.world.device
        vla = vla.to(device)
        if self.world.size == 1:
            return vla
        if self.static_graph is None:
            declared = bool(VLA.adapt(vla).static_graph)
            self.static_graph = declared and not self.find_unused_parameters
        return DistributedDataParallel(
            vla,
            device_ids=[device.index] if device.type == "cuda" else None,
            find_unused_parameters=self.find_unused_parameters,
            gradient_as_bucket_view=True,
            static_graph=self.static_graph,
        )

    def memory_layout(self, model: nn.Module, processes: int, device_type: str) -> Layout:
        """Everything on every process; the buckets that gradients are exchanged in are theirs."""
        from fluxvla_core.training import replicated_layout

        return replicated_layout(model)

    def before_first_step(self, batch: dict[str, Any]) -> None:
        """Let torch rearrange its buckets, and learn a static graph, before the first step.

        DistributedDataParallel orders its buckets by how gradients arrived in its first backward
        pass. With more than two processes that changes the order in which they are added up, so
        the first step of a resumed run would be rounded otherwise than that of one that went on.
        A static graph is learnt in a step of its own before that, and in one that exchanges
        gradients, which the first of several accumulated ones does not.
        """
        needed = self.static_graph or (self.world.size > 2 and not self.find_unused_parameters)
        if self.world.size == 1 or not needed:
            return
        from fluxvla_core.training import rng_state, set_rng_state

        drawn = rng_state()
        buffers = {name: buffer.clone() for name, buffer in self.model.named_buffers()}
        for _ in range(2 if self.static_graph else 1):
            self._training_step(batch).backward()
        self.optimizer.zero_grad(set_to_none=True)
        for name, buffer in self.model.named_buffers():
            buffer.copy_(buffers[name])
        set_rng_state(drawn)

    def sync_gradients(self, last: bool) -> AbstractContextManager[object]:
        whole = last or self.world.size == 1
        return super().sync_gradients(last) if whole else self.vla.no_sync()
