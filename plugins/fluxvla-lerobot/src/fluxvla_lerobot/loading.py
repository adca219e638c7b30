"""A policy of LeRobot with its processors, loaded by LeRobot and checked."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluxvla_core.errors import CheckpointError, ConfigError, FluxError, LoadFailed
from fluxvla_lerobot.files import EMPTY, WEIGHTS, Described
from fluxvla_lerobot.installed import LeRobot

_SHOWN = 6
_DEVICE, _TOKENIZER = "device_processor", "tokenizer_processor"
_MODES_WITHOUT_STATISTICS = "IDENTITY"


@dataclass(frozen=True)
class Loaded:
    """A policy of LeRobot, in evaluation mode, and what is around it.

    Args:
        policy: LeRobot's ``PreTrainedPolicy``.
        before: raw features of one observation -> the policy's batch of one.
        after: the policy's actions -> actions in the units of its training data, on the CPU.
    """

    policy: Any
    before: Any
    after: Any

    def reset(self) -> None:
        """Begin an episode: forget observations, actions and states of the last one."""
        for part in (self.policy, self.before, self.after):
            part.reset()


def load(
    lerobot: LeRobot, folder: Path, described: Described, device: str, tokenizer: str | None
) -> Loaded:
    """Load a policy and its processors through LeRobot's own functions.

    Args:
        device: a torch device.
        tokenizer: folder of the tokenizer, instead of what the checkpoint names.

    Raises:
        ConfigError: there is no such device.
        CheckpointError: LeRobot cannot read it, tensors of the model are not in it, or statistics
            are missing.
        LoadFailed: this version of LeRobot has no such policy, or lacks what it needs.
    """
    where = str(folder)
    overrides = _overrides(described, device, tokenizer)
    _check_device(device)
    # LeRobot prints; what a command prints belongs to whoever asked it.
    with contextlib.redirect_stdout(sys.stderr):
        try:
            config = lerobot.config_class.from_pretrained(
                folder, cli_overrides=[f"--device={device}"]
            )
            if str(config.device).partition(":")[0] != device.partition(":")[0]:
                raise ConfigError(
                    f"LeRobotPolicy: device is {device!r}, and LeRobot finds {config.device!r} here"
                )
            if "pretrained_backbone_weights" in vars(config):
                # They would be downloaded, and then replaced by the checkpoint's.
                config.pretrained_backbone_weights = None
            kind = lerobot.policy_class(described.kind)
            policy = kind.from_pretrained(folder, config=config, strict=True).eval()
            before, after = lerobot.processors(
                policy.config,
                pretrained_path=where,
                preprocessor_overrides=overrides,
            )
        except FluxError:
            raise
        except ImportError as error:
            raise LoadFailed(
                f"LeRobot {lerobot.version} lacks what a policy of type {described.kind!r} needs: "
                f"{_first(error)}",
                where=where,
                next="install that into LeRobot's environment",
            ) from error
        except Exception as error:
            raise CheckpointError(
                f"LeRobot {lerobot.version} does not load it: {_first(error)}",
                where=where,
                cause="it is damaged, of another version of LeRobot, or names a tokenizer or "
                "backbone that cannot be fetched (tokenizer = FOLDER gives it one)",
            ) from error
    check_weights(policy, folder)
    for processor in (before, after):
        check_statistics(processor, lerobot.normalizers, where)
    return Loaded(policy, before, after)


def check_weights(policy: Any, folder: Path) -> None:
    """Check that every tensor of a model came out of its file.

    Some of LeRobot's policies go on with random weights if theirs do not fit. A tensor is of the
    file if it has one of its name (``model.`` may be before it) or, renamed or tied, any other of
    its shape that begins with the same numbers.

    Args:
        policy: a ``torch.nn.Module``.

    Raises:
        CheckpointError: lists what is not.
    """
    import torch

    from fluxvla_core.models import safetensors_in

    stored = safetensors_in(folder)
    by_shape: dict[tuple[int, ...], list[str]] = {}
    for name, tensor in stored.items():
        by_shape.setdefault(tuple(tensor.shape), []).append(name)

    def alike(own: torch.Tensor, name: str) -> bool:
        theirs = stored[name]
        if tuple(theirs.shape) != tuple(own.shape):
            return False
        rows = tuple(slice(0, n if axis else 1) for axis, n in enumerate(own.shape))
        pair = (theirs[rows], own[rows].cpu())
        # A policy may have gone through bfloat16 and back.
        coarse = torch.bfloat16 if own.is_floating_point() else own.dtype
        return torch.equal(*(values.to(own.dtype).to(coarse) for values in pair))

    lost = []
    for name, own in policy.state_dict().items():
        named = [n for n in (name, name.removeprefix("model.")) if n in stored]
        others = by_shape.get(tuple(own.shape), [])
        if not any(alike(own, n) for n in (*named, *others)):
            lost.append(name)
    if lost:
        more = " …" if len(lost) > _SHOWN else ""
        raise CheckpointError(
            f"{len(lost)} of the model's tensors are not those of {WEIGHTS}: "
            f"{', '.join(lost[:_SHOWN])}{more}",
            where=str(folder),
            cause="it is of another model, or was saved by another version of LeRobot, which goes "
            "on with random numbers",
        )


def check_statistics(processor: Any, normalizers: tuple[type, ...], where: str) -> None:
    """Check that a processor has statistics of all that it normalises.

    LeRobot leaves values as they are where it has none: a robot would be sent normalised numbers.

    Raises:
        CheckpointError: names the features without.
    """
    for step in processor.steps:
        if not isinstance(step, normalizers):
            continue
        modes = {str(k.value): str(v.value) for k, v in step.norm_map.items()}
        lacks = [
            name
            for name, feature in step.features.items()
            if modes.get(str(feature.type.value), _MODES_WITHOUT_STATISTICS)
            != _MODES_WITHOUT_STATISTICS
            and not (step.stats or {}).get(name)
            and not name.startswith(EMPTY)
        ]
        if lacks:
            raise CheckpointError(
                f"{type(step).__name__} has no statistics of {', '.join(lacks)}",
                where=where,
                cause="it is a base model, which is to be trained on a robot's data first",
                next="train it in LeRobot on your data, and name the folder of the result",
            )


def _check_device(device: str) -> None:
    import torch

    try:
        torch.device(device)
    except RuntimeError as error:
        raise ConfigError(
            f"LeRobotPolicy: device is {device!r}, and torch knows no such one"
        ) from error


def _overrides(
    described: Described, device: str, tokenizer: str | None
) -> Mapping[str, Mapping[str, Any]]:
    """Settings of the preprocessor's steps that follow from this machine."""
    found: dict[str, Mapping[str, Any]] = {}
    if _DEVICE in described.before:
        found[_DEVICE] = {"device": device}
    if tokenizer is not None:
        if _TOKENIZER not in described.before:
            raise CheckpointError(
                f"tokenizer is {tokenizer!r}, and a policy of type {described.kind!r} has no "
                f"{_TOKENIZER}"
            )
        found[_TOKENIZER] = {"tokenizer_name": tokenizer}
    return found


def _first(error: Exception) -> str:
    lines = [line for line in str(error).strip().splitlines() if line.strip()]
    return f"{type(error).__name__}: {' '.join(lines[:3])}" if lines else type(error).__name__
