"""Policies that are evaluated: of a checkpoint, its untrained baseline, or a registered one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.build import build_policy_from_cfg
from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.environment import Environment, EnvironmentSpec
from fluxvla_core.contracts.frame import Observation
from fluxvla_core.contracts.policy import Actor
from fluxvla_core.errors import ConfigError, SpecMismatch
from fluxvla_core.spec import Camera, EmbodimentSpec, check_match

if TYPE_CHECKING:
    from fluxvla_core.policies.local import LocalPolicy

CHECKPOINT, UNTRAINED, EXPERT, RANDOM = "checkpoint", "untrained", "expert", "random"
FROM_CHECKPOINT = (CHECKPOINT, UNTRAINED)


@dataclass(frozen=True)
class PolicySource:
    """From what a policy is built or loaded; sent to worker processes.

    Args:
        policy: ``checkpoint`` or ``untrained``, or the table of a registered policy; before
            ``resolve`` also ``expert``, ``random`` or another ``type``.
        ckpt_path: the checkpoint's folder, where one is needed; before ``resolve`` also a work dir,
            or None for that of the run.
        dataset, denormalize_action: override those of the checkpoint, see ``load_policy``.
        norm_stats_key: which of its statistics; those it was trained with by default.
        device: a torch device.
        precision: ``float32`` or ``bf16``.
        batch_size: rows of every forward pass; results follow from it.
        execution, quantization: how its model computes, see ``load_policy``; results follow from
            them, because rounding does.
    """

    policy: str | Mapping[str, Any]
    ckpt_path: str | None = None
    dataset: Any = None
    denormalize_action: Any = None
    norm_stats_key: str | None = None
    device: str = "cpu"
    precision: str = "float32"
    batch_size: int = 1
    execution: str = "eager"
    quantization: str | None = None

    def check(self) -> None:
        """Refuse what the model cannot be asked to do here, before anything is loaded.

        Raises:
            ConfigError: ``execution`` or ``quantization`` is unknown, or not available here.
        """
        if self.execution == "eager" and self.quantization is None:
            return  # without torch, which a process that serves no policy does not import
        from fluxvla_core.policies.execution import check_execution
        from fluxvla_core.policies.inference_weights import check_quantization

        check_execution(self.execution)
        check_quantization(self.quantization, self.device)

    def resolve(self, environment: Environment, work_dir: str | Path) -> PolicySource:
        """This source with the name of its policy resolved, and its checkpoint found and verified.

        Raises:
            ConfigError: the environment names no expert; or see ``check``.
            CheckpointError: there is no checkpoint, or the one that is named is damaged.
        """
        policy = resolve_policy(self.policy, environment)
        if policy not in FROM_CHECKPOINT:
            return replace(self, policy=policy)
        self.check()
        found = chosen_checkpoint(self.ckpt_path, Path(work_dir))
        return replace(self, policy=policy, ckpt_path=found["path"])


def resolve_policy(policy: str | Mapping[str, Any], environment: Any) -> str | Mapping[str, Any]:
    """``checkpoint`` or ``untrained`` as they are; everything else as a table with a ``type``.

    Args:
        environment: the environment or its class, whose ``expert`` may be asked for.

    Raises:
        ConfigError: the environment names no expert.
    """
    if not isinstance(policy, str) or policy in FROM_CHECKPOINT:
        return policy
    if policy == RANDOM:
        return {"type": "RandomPolicy"}
    if policy != EXPERT:
        return {"type": policy}
    if not implements(environment, Environment, "expert"):
        cls = environment if isinstance(environment, type) else type(environment)
        raise ConfigError(
            f"{cls.__name__} names no expert",
            next=f"choose another policy: {CHECKPOINT}, {RANDOM}, or dict(type='...')",
        )
    return {"type": environment.expert}


def make_policy(source: PolicySource) -> Actor:
    """Build or load the policy of a resolved source.

    Raises:
        SpecMismatch: the checkpoint has no statistics under ``norm_stats_key``.
        CheckpointError, ConfigError, PluginError: see ``load_policy``, ``build_from_cfg``.
    """
    if not isinstance(source.policy, str):
        return Actor.adapt(build_policy_from_cfg(source.policy))
    return load(source)


def load(source: PolicySource) -> LocalPolicy:
    """The policy of a checkpoint, or its untrained baseline.

    The baseline is the same model with fresh random weights (seed 0) and everything else unchanged;
    it shows what the pipeline does without training.

    Raises:
        CheckpointError, ConfigError, PluginError, SpecMismatch: see ``make_policy``.
    """
    import torch

    from fluxvla_core.checkpoints.checkpoint import Checkpoint
    from fluxvla_core.policies.inference_weights import ready
    from fluxvla_core.policies.loading import load_policy
    from fluxvla_core.training.weights import model_of

    assert source.ckpt_path is not None
    dataset, denormalize = source.dataset, source.denormalize_action
    if source.norm_stats_key is not None:
        dataset, denormalize = _with_statistics(source)
    precision, quantization = source.precision, source.quantization
    policy = load_policy(
        source.ckpt_path,
        source.device,
        dataset,
        denormalize,
        precision,
        source.execution,
        quantization,
    )
    if source.policy == UNTRAINED:
        with torch.random.fork_rng():
            torch.manual_seed(0)
            model = model_of(Checkpoint.open(source.ckpt_path), untrained=True)
        policy.model = ready(model.to(policy.device).eval(), precision, quantization)
    policy.batch_size = source.batch_size
    return policy


def match_policy(
    policy: Actor, spec: EnvironmentSpec, size: tuple[int, int] | None = None
) -> tuple[Camera, ...]:
    """Check that ``policy`` fits the environment; the cameras that it looks at.

    Args:
        policy: if it has no ``embodiment`` it is taken to be made for this environment.
        size: height and width of all images; as in the policy's training data by default.

    Raises:
        SpecMismatch: its numbers mean something else here: joints, units, frames, rotations,
            gripper polarity, absolute or delta, rate; or a camera is missing.
    """
    policy = Actor.adapt(policy)
    return _match(policy.embodiment, tuple(policy.cameras), policy.action_rate_hz, spec, size)


def match_checkpoint(path: str, dataset: Any, spec: EnvironmentSpec) -> None:
    """As ``match_policy``, before the model of the checkpoint at ``path`` is built.

    What it does not say is left to ``load_policy``.

    Args:
        dataset: what prepares observations instead of the checkpoint's, as of ``load_policy``.

    Raises:
        SpecMismatch: see ``match_policy``.
        CheckpointError: a file of the checkpoint is missing or damaged.
    """
    from fluxvla_core.checkpoints.checkpoint import Checkpoint
    from fluxvla_core.data.lerobot import camera_name
    from fluxvla_core.data.mixture import first_dataset

    checkpoint = Checkpoint.open(path)
    robot, rate = checkpoint.embodiment(), checkpoint.policy().get("action_rate_hz")
    own = first_dataset(checkpoint.config().get("train_dataloader", {}).get("dataset", {}))
    table = own if dataset is None else dataset
    keys = table.get("img_keys") if isinstance(table, Mapping) else None
    if robot is not None and rate is not None and keys is not None:
        _match(robot, tuple(camera_name(key) for key in keys), rate, spec, None)


def _match(
    embodiment: EmbodimentSpec | None,
    names: tuple[str, ...],
    rate: float | None,
    spec: EnvironmentSpec,
    size: tuple[int, int] | None,
) -> tuple[Camera, ...]:
    trained = {c.name: c for c in embodiment.cameras} if embodiment is not None else {}
    if embodiment is not None:
        check_match(embodiment, spec.embodiment, "the policy", spec.name, cameras=names)
    if not spec.limited and rate is not None and rate != spec.embodiment.rate_hz:
        raise SpecMismatch(
            f"the policy's actions are for steps of 1/{rate:g} s, "
            f"{spec.name}'s for 1/{spec.embodiment.rate_hz:g} s",
            cause="it was trained on data of another frame rate",
            next=f"train on data recorded at {spec.embodiment.rate_hz:g} frames a second",
        )
    here = {camera.name: camera for camera in spec.embodiment.cameras}
    missing = [name for name in names if name not in here]
    if missing:
        raise SpecMismatch(
            f"the policy looks at {', '.join(missing)}; {spec.name} has {', '.join(here) or 'none'}"
        )
    cameras = [trained.get(name, here[name]) for name in names]
    if size is not None:
        cameras = [replace(camera, height=size[0], width=size[1]) for camera in cameras]
    return tuple(cameras)


class RandomPolicy(Actor):
    """Actions drawn uniformly within the limits of every joint: the success rate of chance alone.

    Args:
        horizon: actions in a chunk.
    """

    cameras: tuple[str, ...] = ()
    horizon: int

    def __init__(self, horizon: int = 1) -> None:
        if horizon < 1:
            raise ConfigError(f"RandomPolicy: horizon must be at least 1, got {horizon}")
        self.horizon = horizon
        self._rng = np.random.default_rng(0)
        self._low = self._high = np.zeros(0)

    def enter(self, environment: Environment) -> None:
        joints = environment.spec.embodiment.joints
        self._low = np.array([joint.lower for joint in joints])
        self._high = np.array([joint.upper for joint in joints])

    def reset(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def predict_action(self, observation: Observation) -> npt.NDArray[np.float64]:
        """``(horizon, dim)``."""
        return self._rng.uniform(self._low, self._high, (self.horizon, len(self._low)))


def _with_statistics(source: PolicySource) -> tuple[Any, Any]:
    """Dataset and denormalization tables with the source's ``norm_stats_key`` in both."""
    from fluxvla_core.checkpoints.checkpoint import Checkpoint
    from fluxvla_core.data.mixture import first_dataset

    assert source.ckpt_path is not None
    checkpoint, key = Checkpoint.open(source.ckpt_path), source.norm_stats_key
    have = checkpoint.statistics()
    if key not in have:
        raise SpecMismatch(
            f"the checkpoint has no statistics {key!r}; it has {', '.join(sorted(have))}",
            where=str(checkpoint.path),
            cause="it was trained on another dataset, or under another statistic_name",
            next="give one of these: --set <section>.norm_stats_key=NAME, or leave it out",
        )
    dataset, denormalize = source.dataset, source.denormalize_action
    if dataset is None:
        trained_on = first_dataset(checkpoint.config()["train_dataloader"]["dataset"])
        wanted = ("img_keys", "transforms", "embodiment_id")
        dataset = {k: trained_on[k] for k in wanted if k in trained_on}
        dataset["type"] = "PrivateInferenceDataset"
    if isinstance(dataset, Mapping):
        dataset = {**dataset, "statistic_name": key}
    if isinstance(denormalize, Mapping):
        denormalize = {**denormalize, "statistic_name": key}
    return dataset, denormalize


def chosen_checkpoint(ckpt_path: str | None, work_dir: Path) -> dict[str, Any]:
    """Find and verify a checkpoint: ``path``, ``step`` and ``sha256`` of its manifest.

    Args:
        ckpt_path: a checkpoint's folder, or a work dir, whose newest undamaged one is taken;
            ``work_dir`` by default.

    Raises:
        CheckpointError: there is none, or the one that is named is damaged.
    """
    from fluxvla_core.checkpoints.checkpoint import Checkpoint
    from fluxvla_core.checkpoints.manifest import NAME, hash_file
    from fluxvla_core.policies.loading import find_checkpoint

    path = find_checkpoint(ckpt_path, work_dir)
    checkpoint = Checkpoint.open(path)
    checkpoint.verify()
    return {"path": str(path), "step": checkpoint.step, "sha256": hash_file(path / NAME)}


def policy_tables(path: str) -> list[Any]:
    """The tables of a checkpoint's config from which its policy is built."""
    from fluxvla_core.checkpoints.checkpoint import Checkpoint

    config = Checkpoint.open(path).config()
    return [config.get(name) for name in ("model", "train_dataloader")]
