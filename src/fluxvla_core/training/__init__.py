"""Training: what a training strategy is written with.

A strategy subclasses :class:`BaseTrainRunner`. The other names need torch, which is imported when
one of them is first used: a config that trains is checked without it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fluxvla_core import _lazy

if TYPE_CHECKING:
    from fluxvla_core.checkpoints.shards import Stored as Stored
    from fluxvla_core.contracts.runner import TrainRunner as TrainRunner
    from fluxvla_core.contracts.training import VLA as VLA
    from fluxvla_core.contracts.training import Collator as Collator
    from fluxvla_core.contracts.training import Dataset as Dataset
    from fluxvla_core.contracts.training import Metric as Metric
    from fluxvla_core.contracts.training import Optimizer as Optimizer
    from fluxvla_core.contracts.training import RandomTransform as RandomTransform
    from fluxvla_core.contracts.training import Tokenizer as Tokenizer
    from fluxvla_core.contracts.training import Transform as Transform
    from fluxvla_core.training.base_runner import BaseTrainRunner as BaseTrainRunner
    from fluxvla_core.training.distributed import World as World
    from fluxvla_core.training.distributed import broadcast_buffers as broadcast_buffers
    from fluxvla_core.training.model import Layout as Layout
    from fluxvla_core.training.model import bare as bare
    from fluxvla_core.training.model import decay_groups as decay_groups
    from fluxvla_core.training.model import nbytes as nbytes
    from fluxvla_core.training.model import refuse_scalars as refuse_scalars
    from fluxvla_core.training.model import replicated_layout as replicated_layout
    from fluxvla_core.training.model import trainable as trainable
    from fluxvla_core.training.model import units_of as units_of
    from fluxvla_core.training.state import rng_state as rng_state
    from fluxvla_core.training.state import set_rng_state as set_rng_state
    from fluxvla_core.training.weights import external_weights as external_weights

_DEPRECATED = {
    "left_out": "external_weights",
    "share_buffers": "broadcast_buffers",
    "whole": "replicated_layout",
}
__getattr__, __dir__, __all__ = _lazy.attach(__name__, _DEPRECATED)
