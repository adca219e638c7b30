"""A policy from a checkpoint alone: model, transforms, statistics and robot are all in it."""

from __future__ import annotations

import inspect
import os
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.build import (
    build_dataset_from_cfg,
    build_transform_from_cfg,
    build_vla_from_cfg,
    parameters,
)
from fluxvla_core.checkpoints.checkpoint import Checkpoint, folders, newest_whole
from fluxvla_core.config.snapshot import work_dirs_below
from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.frame import Observation
from fluxvla_core.contracts.policy import Continuation, Policy
from fluxvla_core.contracts.training import InferenceDataset, Transform
from fluxvla_core.data.inference_dataset import PrivateInferenceDataset
from fluxvla_core.data.lerobot import camera_name
from fluxvla_core.data.mixture import first_dataset
from fluxvla_core.errors import CheckpointError, ConfigError, SpecMismatch
from fluxvla_core.plugins.registry import DATASETS, TRANSFORMS, Registry
from fluxvla_core.spec.embodiment import EmbodimentSpec

Array = npt.NDArray[np.float64]
# float32 statistics and the sizes that joints have: far above rounding, far below a mistake.
_CLOSE = 1e-4
PRECISIONS = ("float32", "bf16")


@dataclass(frozen=True)
class Question:
    """One episode's question: what it sees, its seed, how many it asked before, and what the
    answer has to go on from."""

    observation: Observation
    seed: int
    call: int
    rest: Continuation | None = None


class LocalPolicy(Policy):
    """A model in this process as the Policy contract has it; ``load_policy`` makes one.

    The noise of call ``n`` of an episode follows from (seed, n) alone, so that an episode can be
    repeated. ``stages`` holds the seconds that the last call took: ``preprocess``,
    ``inference``, ``postprocess``. Every forward pass has ``batch_size`` rows (1 unless it is
    set), however many questions there are: kernels, and so sums, depend on the size.

    Args:
        model: ``predict_action(**batch) -> (B, T, D)``, in evaluation mode.
        prepare: observation -> batch of one.
        denormalize: ``{"action": (1, T, D), "states": (S,)}`` -> ``(T, dim)`` physical units.
        embodiment: the robot that it was trained for.
        cameras: names of the pictures that ``prepare`` looks at.
        action_rate_hz, horizon: of a chunk.
        device: where the model is.
        precision: ``float32`` or ``bf16`` (autocast).
        source: where it came from, for records.
    """

    embodiment: EmbodimentSpec
    cameras: tuple[str, ...]
    action_rate_hz: float
    horizon: int
    source: str
    stages: dict[str, float]

    def __init__(
        self,
        model: Any,
        prepare: Callable[[Mapping[str, Any]], dict[str, Any]],
        denormalize: Callable[[Mapping[str, Any]], Array],
        embodiment: EmbodimentSpec,
        cameras: tuple[str, ...],
        action_rate_hz: float,
        horizon: int,
        device: str = "cpu",
        precision: str = "float32",
        source: str = "",
    ) -> None:
        if precision not in PRECISIONS:
            raise ConfigError(
                f"mixed_precision_dtype {precision!r} is none of {', '.join(PRECISIONS)}"
            )
        self.model = model
        self.embodiment = embodiment
        self.cameras = cameras
        self.action_rate_hz = action_rate_hz
        self.horizon = horizon
        self.source = source
        self.batch_size = 1
        self.stages = {}
        self._prepare = prepare
        self._denormalize = denormalize
        self.device = device
        self._precision = precision
        self._seed = 0
        self._calls = 0
        taken = inspect.signature(model.predict_action).parameters
        self._takes_all = any(p.kind is p.VAR_KEYWORD for p in taken.values())
        self._takes = set(taken)

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self._seed, self._calls = seed, 0

    def predict_action(self, observation: Observation) -> Array:
        """``(horizon, dim)`` float64 in physical units; key ``j`` is for ``(j + 1) / rate``.

        Raises:
            DataError, ConfigError: the observation lacks something that the transforms need.
        """
        chunk = self.predict_batch([Question(observation, self._seed, self._calls)])[0]
        self._calls += 1
        return chunk

    @property
    def continues(self) -> bool:
        """Whether its model takes the rest of a chunk, and what it makes can be scaled back."""
        if "prev_actions" not in self._takes:
            return False
        zeros = np.zeros(self.embodiment.state_dim)
        return scaling_of(self._denormalize, self.model.action_shape, zeros) is not None

    def continue_action(self, observation: Observation, rest: Continuation) -> Array:
        """As ``predict_action``, for a chunk that goes on from ``rest`` (``ContinuesChunks``).

        The model gets ``prev_actions`` ``(1, T, D)`` normalised, ``prefix_weights`` ``(1, T)``,
        ``prefix_len`` ``(1,)`` and ``max_guidance_weight`` ``(1,)``.

        Raises:
            ConfigError: the model takes no such thing, or its actions cannot be scaled back.
            DataError: the observation lacks something that the transforms need.
        """
        question = Question(observation, self._seed, self._calls, rest)
        chunk = self.predict_batch([question])[0]
        self._calls += 1
        return chunk

    def predict_batch(self, questions: Sequence[Question]) -> list[Array]:
        """An answer to each of at most ``batch_size`` questions, in one forward pass.

        Either all of them go on from a chunk, or none does.

        Raises:
            DataError, ConfigError: an observation lacks something that the transforms need.
        """
        import torch

        if not 1 <= len(questions) <= self.batch_size:
            raise ValueError(f"{len(questions)} questions, and batch_size is {self.batch_size}")
        start = time.perf_counter()
        rows = [self._row(question) for question in questions]
        rows += rows[:1] * (self.batch_size - len(rows))
        device = torch.device(self.device)
        batch = {
            key: torch.cat([row[key] for row in rows]).to(device)
            if isinstance(value, torch.Tensor)
            else [item for row in rows for item in row[key]]
            for key, value in rows[0].items()
        }
        prepared = time.perf_counter()
        mixed = self._precision == "bf16"
        # A model that is guided differentiates, which tensors of inference_mode do not allow.
        mode = torch.no_grad() if "prev_actions" in batch else torch.inference_mode()
        with mode, torch.autocast(device.type, torch.bfloat16, enabled=mixed):
            actions = self.model.predict_action(**batch).float().cpu().numpy()
        inferred = time.perf_counter()
        chunks = [
            self._denormalize(
                {
                    "action": actions[place : place + 1],
                    "states": np.asarray(question.observation["qpos"]),
                }
            )
            for place, question in enumerate(questions)
        ]
        self.stages = {
            "preprocess": prepared - start,
            "inference": inferred - prepared,
            "postprocess": time.perf_counter() - inferred,
        }
        return chunks

    def _row(self, question: Question) -> dict[str, Any]:
        """A batch of one, with what the model takes."""
        import torch

        row = self._prepare(self._sized(question.observation))
        if "noise" in self._takes:
            row["noise"] = torch.from_numpy(self._noise(question.seed, question.call))
        if question.rest is not None:
            row |= self._rest(question.rest, question.observation)
        if not self._takes_all:
            row = {key: value for key, value in row.items() if key in self._takes}
        return row

    def _rest(self, rest: Continuation, observation: Observation) -> dict[str, Any]:
        """The rest of a chunk as the model takes it, a batch of one."""
        import torch

        states = np.asarray(observation["qpos"], dtype=np.float64)
        scaling = scaling_of(self._denormalize, self.model.action_shape, states)
        if "prev_actions" not in self._takes or scaling is None:
            raise ConfigError(
                f"the policy of {self.source or 'this model'} cannot go on from a chunk"
            )
        actions = scaling.normalized(rest.actions)
        return {
            "prev_actions": torch.from_numpy(actions.astype(np.float32))[None],
            "prefix_weights": torch.from_numpy(rest.weights.astype(np.float32))[None],
            "prefix_len": torch.tensor([rest.frozen]),
            "max_guidance_weight": torch.tensor([rest.max_guidance_weight], dtype=torch.float32),
        }

    def _sized(self, observation: Observation) -> dict[str, Any]:
        """The observation with pictures of the size that the policy was trained on.

        The transforms may cut pixels by number. A camera with more pixels of the same view is
        scaled down; ``run_setup`` has refused another view.
        """
        images = dict(observation["images"])
        for camera in self.embodiment.cameras:
            image = images.get(camera.name)
            if image is not None and image.shape[:2] != (camera.height, camera.width):
                import cv2

                size = (camera.width, camera.height)
                images[camera.name] = np.asarray(
                    cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8
                )
        return {**observation, "images": images}

    def _noise(self, seed: int, call: int) -> npt.NDArray[np.float32]:
        # A key of its own for each call; counter-based, so that calls share no numbers.
        key = np.array([seed, call], dtype=np.uint64)
        generator = np.random.Generator(np.random.Philox(key=key))
        shape = (1, *self.model.action_shape)
        return generator.standard_normal(shape, dtype=np.float32)


def load_policy(
    ckpt_path: str | Path,
    device: str = "cpu",
    dataset: Any = None,
    denormalize_action: Any = None,
    mixed_precision_dtype: str = "float32",
) -> LocalPolicy:
    """Build the policy that a checkpoint holds; its config is data and never executed.

    Args:
        ckpt_path: a checkpoint's folder, or a work dir, whose newest one is taken.
        device: of torch; a plain ``cuda`` is ``own_device``'s.
        dataset: table or object that prepares observations instead of the training dataset's
            transforms (the specification's ``PrivateInferenceDataset``); what it does not set,
            ``norm_stats`` and ``processors``, is the checkpoint's.
        denormalize_action: table or object instead of the inverse of the training's
            normalisation; ``norm_stats`` is the checkpoint's if it is not set.
        mixed_precision_dtype: ``float32`` or ``bf16``.

    Raises:
        CheckpointError: it is missing, damaged, or of another model.
        SpecMismatch: it does not say for which robot, or at which rate, its actions are.
        ConfigError, PluginError: a part that its config names cannot be built here.
    """
    checkpoint = Checkpoint.open(ckpt_path)
    checkpoint.verify()
    where = str(checkpoint.path)
    config = checkpoint.config()
    embodiment, facts = checkpoint.embodiment(), checkpoint.policy()
    unknown = [key for key in ("action_rate_hz", "horizon") if facts.get(key) is None]
    if embodiment is None or unknown:
        lacks = ", ".join([*(["the embodiment"] if embodiment is None else []), *unknown])
        raise SpecMismatch(
            f"the checkpoint does not say {lacks}: what its actions mean is unknown",
            where=where,
            cause="the dataset that it was trained on did not say",
            next="train on a dataset with an embodiment; fluxvla writes it on recording",
        )
    trained_on = first_dataset(config.get("train_dataloader", {}).get("dataset", {}))
    if trained_on.get("use_delta"):
        raise SpecMismatch(
            "the policy was trained with use_delta=True: differences from frame to frame, "
            "which no robot here takes",
            where=where,
            next="train with relative_actions=True, whose chunks come out absolute",
        )
    prepare = _prepare(dataset, trained_on, checkpoint)
    denormalize = _denormalize(denormalize_action, prepare, checkpoint)
    if device == "cuda":
        import torch

        device = own_device(os.environ, torch.cuda.device_count())
    model = _model(config, checkpoint, device)
    keys = tuple(getattr(prepare, "img_keys", embodiment.camera_names))
    return LocalPolicy(
        model=model,
        prepare=prepare,
        denormalize=denormalize,
        embodiment=embodiment,
        cameras=tuple(camera_name(key) for key in keys),
        action_rate_hz=float(facts["action_rate_hz"]),
        horizon=int(facts["horizon"]),
        device=device,
        precision=mixed_precision_dtype,
        source=where,
    )


def own_device(environment: Mapping[str, str], count: int) -> str:
    """The GPU of this process: of several on one machine each has its own, as far as they reach.

    Args:
        environment: of the process; torchrun sets ``LOCAL_RANK``, ``srun`` ``SLURM_LOCALID``.
        count: how many GPUs it sees.
    """
    local = environment.get("LOCAL_RANK", environment.get("SLURM_LOCALID"))
    return "cuda" if local is None or count < 1 else f"cuda:{int(local) % count}"


def find_checkpoint(ckpt_path: str | Path | None, work_dir: Path) -> Path:
    """The checkpoint to load: the one that is named, else the newest whole one of the work dir.

    Raises:
        CheckpointError: there is none; what was wrong with damaged ones is said.
    """
    if ckpt_path is not None:
        return Checkpoint.open(ckpt_path).path
    found, refused = newest_whole(work_dir)
    if found is not None:
        return found.path
    damaged = "; ".join(error.what for error in refused)
    others = [shlex.quote(str(p)) for p in work_dirs_below(Path()) if folders(p)][:3]
    here = f", such as {' or '.join(others)}" if others else ""
    raise CheckpointError(
        f"there is no whole checkpoint in {work_dir}" + (f": {damaged}" if damaged else ""),
        next=f"train first (--section runner), or name the work dir of a training{here}: "
        f"--work-dir {others[0] if others else 'DIR'}",
    )


def _model(config: Mapping[str, Any], checkpoint: Checkpoint, device: str) -> Any:
    from fluxvla_core.training.weights import load_for_inference

    if "model" not in config:
        raise CheckpointError(
            "the checkpoint's config has no section 'model'", where=str(checkpoint.path)
        )
    model = build_vla_from_cfg(config["model"])
    load_for_inference(model, checkpoint)
    return model.to(device).eval()


def _prepare(dataset: Any, trained_on: Mapping[str, Any], checkpoint: Checkpoint) -> Any:
    defaults: dict[str, Any] = {
        "norm_stats": checkpoint.statistics(),
        "processors": checkpoint.processors,
    }
    if dataset is not None:
        return build_dataset_from_cfg(dataset, **_taken(dataset, DATASETS, defaults))
    missing = [key for key in ("img_keys", "transforms") if key not in trained_on]
    if missing:
        raise CheckpointError(
            f"the checkpoint's train_dataloader.dataset has no {', '.join(missing)}: "
            "how its observations are prepared is unknown",
            where=str(checkpoint.path),
            next="give the section dataset = dict(type='PrivateInferenceDataset', ...)",
        )
    wanted = ("img_keys", "transforms", "embodiment_id", "statistic_name")
    taken = {key: trained_on[key] for key in wanted if key in trained_on}
    return PrivateInferenceDataset(**taken, **defaults)


def _denormalize(given: Any, prepare: Any, checkpoint: Checkpoint) -> Any:
    statistics = checkpoint.statistics()
    if given is not None:
        defaults = {"norm_stats": statistics}
        return build_transform_from_cfg(given, **_taken(given, TRANSFORMS, defaults))
    described = InferenceDataset.adapt(prepare)
    for transform in described.pipeline.transforms if described.pipeline is not None else ():
        if implements(transform, Transform, "denormalizer"):
            return transform.denormalizer(statistics, described.statistic_name)
    raise ConfigError(
        "no transform tells how actions were normalised",
        where=str(checkpoint.path),
        next="give the section denormalize_action = dict(type='DenormalizePrivateAction', ...)",
    )


def _taken(table: Any, registry: Registry, defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Those ``defaults`` that the class which a table names has parameters for."""
    if not isinstance(table, Mapping) or not isinstance(table.get("type"), str):
        return {}
    names = parameters(registry.get(table["type"]))
    return {key: value for key, value in defaults.items() if key in names}


@dataclass(frozen=True)
class Scaling:
    """From a policy's actions back to what its model computes with, whatever made them physical.

    ``physical = offset + slope * normalized``, both ``(T, D)``; the model's rows are wider.

    A checkpoint, or a config, says how a model's actions become a robot's
    (``denormalize_action``). What undoes that is not said, and may depend on the state (actions
    relative to it). But whatever can be undone scales and shifts, element by element, so that two
    of its answers tell it all.
    """

    offset: Array
    slope: Array
    width: int

    def normalized(self, actions: Array) -> Array:
        """``(T, D)`` physical -> ``(T, width)``; 0 where nothing depends on the model's value."""
        fixed = self.slope == 0.0
        values = np.where(fixed, 0.0, (actions - self.offset) / np.where(fixed, 1.0, self.slope))
        return np.pad(values, ((0, 0), (0, self.width - values.shape[1])))


def scaling_of(
    denormalize: Callable[[Mapping[str, Any]], Array], shape: tuple[int, int], states: Array
) -> Scaling | None:
    """What ``denormalize`` does to a chunk of ``shape`` ``(T, width)`` in ``states`` ``(S,)``.

    None if it does not scale and shift element by element: it rounds, clips or mixes.
    """
    rng = np.random.default_rng(0)
    probe = rng.uniform(-1.0, 1.0, shape)
    zeros, ones, found = (
        denormalize({"action": rows[None].astype(np.float32), "states": states})
        for rows in (np.zeros(shape), np.ones(shape), probe)
    )
    scaling = Scaling(zeros, ones - zeros, shape[1])
    expected = zeros + scaling.slope * probe[:, : zeros.shape[1]]
    size = np.abs(zeros).max() + np.abs(ones).max() + 1e-12
    return scaling if np.allclose(found, expected, rtol=0.0, atol=_CLOSE * size) else None
