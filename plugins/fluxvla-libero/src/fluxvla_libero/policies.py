"""Policies that an evaluation can measure: a checkpoint's, and what to compare it with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from fluxvla_core.errors import SpecMismatch

if TYPE_CHECKING:
    from fluxvla_core.contracts.protocols import Policy

POLICIES = ("checkpoint", "expert", "untrained")
NEEDS_CHECKPOINT = ("checkpoint", "untrained")


@dataclass(frozen=True)
class Loading:
    """How a checkpoint becomes a policy.

    Args:
        ckpt_path: its folder, where one is needed.
        dataset, denormalize_action: instead of what the checkpoint says, see ``load_policy``.
        norm_stats_key: which of its statistics; what it was trained with by default.
        device: of torch.
        precision: ``float32`` or ``bf16``.
    """

    ckpt_path: str | None = None
    dataset: Any = None
    denormalize_action: Any = None
    norm_stats_key: str | None = None
    device: str = "cpu"
    precision: str = "float32"


def make_policy(name: str, loading: Loading) -> Policy:
    """The policy called ``name``, one of ``POLICIES``.

    ``untrained`` is the checkpoint's model with fresh random weights (seed 0) and everything else
    as it is: what the same pipeline does without having learned.

    Raises:
        SpecMismatch: the checkpoint has no statistics under ``norm_stats_key``.
        CheckpointError, ConfigError, PluginError: see ``load_policy``.
    """
    if name == "expert":
        from fluxvla_libero.expert import ExpertPolicy

        return ExpertPolicy()
    from fluxvla_core.evaluate.subject import untrained_model
    from fluxvla_core.infer.local_policy import load_policy

    assert loading.ckpt_path is not None
    dataset, denormalize = loading.dataset, loading.denormalize_action
    if loading.norm_stats_key is not None:
        dataset, denormalize = _with_statistics(loading)
    policy = load_policy(loading.ckpt_path, loading.device, dataset, denormalize, loading.precision)
    if name == "untrained":
        policy.model = untrained_model(loading.ckpt_path, loading.device)
    return policy


def _with_statistics(loading: Loading) -> tuple[Any, Any]:
    """The section's tables with the statistics' key in both."""
    from fluxvla_core.train.checkpoint import Checkpoint

    assert loading.ckpt_path is not None
    checkpoint, key = Checkpoint.open(loading.ckpt_path), loading.norm_stats_key
    have = checkpoint.statistics()
    if key not in have:
        raise SpecMismatch(
            f"the checkpoint has no statistics {key!r}; it has {', '.join(sorted(have))}",
            where=str(checkpoint.path),
            cause="it was trained on another dataset, or under another statistic_name",
            next="set norm_stats_key to one of these, or leave it out",
        )
    dataset, denormalize = loading.dataset, loading.denormalize_action
    if dataset is None:
        trained_on = checkpoint.config()["train_dataloader"]["dataset"]
        wanted = ("img_keys", "transforms", "embodiment_id")
        dataset = {k: trained_on[k] for k in wanted if k in trained_on}
        dataset["type"] = "PrivateInferenceDataset"
    if isinstance(dataset, Mapping):
        dataset = {**dataset, "statistic_name": key}
    if isinstance(denormalize, Mapping):
        denormalize = {**denormalize, "statistic_name": key}
    return dataset, denormalize
