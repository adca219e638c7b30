"""Latency of a policy, stage by stage: ``fluxvla bench-policy``.

One observation after another is asked for a chunk, as a robot does. What is measured follows from
the command line alone (images, states and weights are drawn from ``seed``), so that anybody can
repeat a published figure.
"""

from __future__ import annotations

import hashlib
import os
import platform
import resource
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.build import build_vla_from_cfg, robot_of
from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.frame import Observation
from fluxvla_core.contracts.policy import with_history
from fluxvla_core.contracts.training import Transform
from fluxvla_core.data.example import unit_statistics
from fluxvla_core.data.inference_dataset import PrivateInferenceDataset
from fluxvla_core.data.lerobot import camera_name
from fluxvla_core.data.mixture import first_dataset
from fluxvla_core.errors import ConfigError, UsageError
from fluxvla_core.plugins._metadata import version
from fluxvla_core.policies.local import LocalPolicy, Query
from fluxvla_core.spec import EmbodimentSpec

if TYPE_CHECKING:
    import torch

    from fluxvla_core.policies.roofline import Work

STAGES = ("preprocess", "transfer", "prefix", "denoise", "forward", "postprocess", "total")
"""In their order; a model has ``prefix`` and ``denoise``, or ``forward``."""
_PACKAGES = ("fluxvla-core", "torch", "torchao", "transformers", "numpy")
_MATRIX = 1024
_COPIED = 64 * 2**20


@dataclass(frozen=True)
class Latencies:
    """Seconds of each call, by stage.

    Args:
        stages: stage -> ``(calls,)`` seconds; ``total`` is from observation to chunk.
        first_s: seconds of the first call, which loads, compiles and allocates.
        memory_mb: most memory of the GPU, or of the process on a CPU, since it began.
    """

    stages: Mapping[str, npt.NDArray[np.float64]]
    first_s: float
    memory_mb: float

    def to_dict(self) -> dict[str, Any]:
        """JSON values: percentiles in ms."""
        found: dict[str, Any] = {
            stage: {
                f"p{percent}_ms": round(float(np.percentile(seconds, percent)) * 1e3, 3)
                for percent in (50, 95, 99)
            }
            for stage, seconds in self.stages.items()
        }
        hz = round(1.0 / float(np.median(self.stages["total"])), 2)
        first, memory = round(self.first_s, 3), round(self.memory_mb, 1)
        return {**found, "hz": hz, "first_call_s": first, "memory_mb": memory}


def measure(
    policy: LocalPolicy, observations: Sequence[Observation], calls: int, warmup: int
) -> Latencies:
    """Ask ``policy`` ``warmup + calls`` times, going through ``observations`` again and again."""
    _forget_memory(policy.device)
    policy.reset(0)
    begun = time.perf_counter()
    policy.predict_action(observations[0])
    first = time.perf_counter() - begun
    rows: list[dict[str, float]] = []
    for call in range(warmup + calls):
        begun = time.perf_counter()
        policy.predict_action(observations[call % len(observations)])
        total = time.perf_counter() - begun
        if call >= warmup:
            rows.append({**policy.stages, **policy.parts, "total": total})
    taken = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return Latencies(taken, first, _memory_mb(policy.device))


def answers(policy: LocalPolicy, observations: Sequence[Observation]) -> npt.NDArray[np.float64]:
    """``(N, T, dim)``: the chunks of an episode that begins with seed 0."""
    policy.reset(0)
    return np.stack([policy.predict_action(observation) for observation in observations])


def random_observations(
    policy: LocalPolicy, task: str, seed: int, count: int = 4
) -> list[Observation]:
    """Images of noise of the robot's sizes, and states within its limits."""
    rng = np.random.default_rng(seed)
    robot = policy.embodiment
    joints = robot.state_joints or robot.joints
    lower, upper = (np.array([getattr(j, end) for j in joints]) for end in ("lower", "upper"))
    observations: list[Observation] = [
        {
            "images": {
                camera.name: rng.integers(0, 256, (camera.height, camera.width, 3), np.uint8)
                for camera in robot.cameras
                if camera.name in policy.cameras
            },
            "qpos": rng.uniform(lower, upper).astype(np.float32),
            "task_description": task,
        }
        for _ in range(count)
    ]
    steps = policy.n_obs_steps
    return [with_history(seen, steps, observations[:i]) for i, seen in enumerate(observations)]


def untrained_policy(
    config: Mapping[str, Any],
    embodiment: EmbodimentSpec | None,
    device: str,
    precision: str,
    seed: int,
    quantization: str | None = None,
) -> LocalPolicy:
    """The policy that a config trains, with random weights and statistics of 0 and 1.

    Args:
        embodiment: the robot; by default that of the config, see ``robot_of``.

    Raises:
        ConfigError: the config lacks the model, its dataset's transforms, or the robot; or the
            robot lacks a camera.
    """
    if "model" not in config:
        raise ConfigError("the config has no section 'model'")
    robot = embodiment or robot_of(config)
    if robot is None:
        raise UsageError(
            "the config has no inference.operator, so the robot of its actions is unknown",
            next="--embodiment FILE",
        )
    dataset = first_dataset(config.get("train_dataloader", {}).get("dataset", {}))
    missing = [key for key in ("img_keys", "transforms") if key not in dataset]
    if missing:
        raise ConfigError(
            f"train_dataloader.dataset has no {', '.join(missing)}: how observations are prepared "
            "is unknown"
        )
    cameras = tuple(camera_name(key) for key in dataset["img_keys"])
    absent = [camera for camera in cameras if camera not in robot.camera_names]
    if absent:
        raise ConfigError(
            f"train_dataloader.dataset.img_keys names {', '.join(map(repr, absent))}; "
            f"{robot.name} has {', '.join(robot.camera_names) or 'no cameras'}",
            next="the operator's camera_names, or --embodiment, has to have every camera that the "
            "policy looks at",
        )
    name = dataset.get("statistic_name", "private")
    statistics = {
        name: {"proprio": unit_statistics(robot.state_dim), "action": unit_statistics(robot.dim)}
    }
    prepare = PrivateInferenceDataset(
        dataset["img_keys"],
        dataset["transforms"],
        norm_stats=statistics,
        embodiment_id=dataset.get("embodiment_id"),
        statistic_name=name,
    )
    normalizers = [
        t for t in prepare.pipeline.transforms if implements(t, Transform, "denormalizer")
    ]
    if not normalizers:
        raise ConfigError("no transform of train_dataloader.dataset normalises actions")
    import torch

    from fluxvla_core.policies.inference_weights import check_quantization, ready
    from fluxvla_core.training.input_sizes import declared_sizes, vocabulary_of

    check_quantization(quantization, device)
    torch.manual_seed(seed)
    model = build_vla_from_cfg(config["model"])
    horizon, _ = model.action_shape
    return LocalPolicy(
        model=ready(model.to(device).eval(), precision, quantization),
        prepare=prepare,
        denormalize=normalizers[0].denormalizer(statistics, name),
        embodiment=robot,
        cameras=cameras,
        action_rate_hz=robot.rate_hz,
        horizon=horizon,
        device=device,
        precision=precision,
        source="random weights",
        vocabulary=vocabulary_of(declared_sizes(config["model"])),
    )


def inference_work(policy: LocalPolicy, observation: Observation) -> dict[str, Work]:
    """Operations and bytes of one answer, by stage on the device; without the step tables."""
    import torch

    from fluxvla_core.policies.execution import Eager
    from fluxvla_core.policies.roofline import work_of

    device = torch.device(policy.device)
    batch = {
        key: value.to(device) if isinstance(value, torch.Tensor) else value
        for key, value in policy.host_batch([Query(observation, 0, 0)]).items()
    }
    plain = Eager(policy.model)
    mixed = torch.autocast(device.type, torch.bfloat16, enabled=policy.precision == "bf16")
    with torch.inference_mode(), mixed:
        parts = plain.parts
        if parts is None:
            return {"forward": work_of(lambda: policy.model.predict_action(**batch))[1]}
        seen, prefix = work_of(lambda: policy.model.observe(**parts.observation(batch)))
        tables = plain.tables()
        _, steps = work_of(lambda: policy.model.denoise(seen, batch["noise"], tables))
    return {"prefix": prefix, "denoise": steps}


def fixture(observations: Sequence[Observation]) -> dict[str, npt.NDArray[Any]]:
    """Images and states of all ``observations``, stacked: what was asked, to be kept."""
    cameras = observations[0]["images"]
    found = {
        f"images.{name}": np.stack([o["images"][name] for o in observations]) for name in cameras
    }
    return {**found, "qpos": np.stack([o["qpos"] for o in observations])}


def digest(arrays: Mapping[str, npt.NDArray[Any]]) -> str:
    """SHA-256 of names, shapes, types and numbers."""
    found = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        found.update(f"{name} {array.shape} {array.dtype.str}\n".encode())
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def peak_tflops(device: str, precision: str, given: float | None) -> tuple[float, str]:
    """The device's peak and where the figure is from: given, its maker's, or measured."""
    if given is not None:
        return given, "given"
    import torch

    from fluxvla_core.training import cost

    dtype = torch.bfloat16 if precision == "bf16" else torch.float32
    if torch.device(device).type == "cuda":
        known = cost.known_peak(torch.cuda.get_device_name(device), dtype)
        if known is not None:
            return known, "its maker's"
    return _measured_tflops(device, dtype), f"a product of two {_MATRIX} x {_MATRIX} matrices"


def bandwidth_gb_s(device: str) -> tuple[float, str]:
    """GB/s of the device's memory and where the figure is from: its maker, or measured."""
    import torch

    from fluxvla_core.policies.roofline import known_bandwidth

    if torch.device(device).type == "cuda":
        known = known_bandwidth(torch.cuda.get_device_name(device))
        if known is not None:
            return known, "its maker's"
    source = torch.ones(_COPIED, dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    seconds = _quickest(lambda: target.copy_(source), device)
    return 2 * _COPIED / seconds / 1e9, f"a copy of {_COPIED // 2**20} MiB"


def machine(device: str) -> dict[str, Any]:
    """The device, threads and versions that a measurement belongs to."""
    import torch

    gpu = torch.cuda.get_device_name(device) if torch.device(device).type == "cuda" else None
    return {
        "device": gpu or f"{platform.machine()}, {os.cpu_count()} CPUs",
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in _PACKAGES},
    }


def _measured_tflops(device: str, dtype: torch.dtype) -> float:
    import torch

    left, right = (torch.randn(_MATRIX, _MATRIX, device=device, dtype=dtype) for _ in range(2))
    return 2 * _MATRIX**3 / _quickest(lambda: torch.mm(left, right), device) / 1e12


def _quickest(work: Callable[[], Any], device: str) -> float:
    """Seconds of the quickest of ten runs."""
    import torch

    cuda = torch.device(device).type == "cuda"
    best = float("inf")
    for _ in range(10):
        begun = time.perf_counter()
        work()
        if cuda:
            torch.cuda.synchronize()
        best = min(best, time.perf_counter() - begun)
    return best


def _forget_memory(device: str) -> None:
    import torch

    if torch.device(device).type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def _memory_mb(device: str) -> float:
    import torch

    if torch.device(device).type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e6
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / 1e6 if sys.platform == "darwin" else most / 1e3
