"""Loading a policy from a checkpoint: model, transforms, statistics and robot are all in it."""

from __future__ import annotations

import inspect
import logging
import os
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from fluxvla_core.build import (
    build_dataset_from_cfg,
    build_transform_from_cfg,
    parameters,
)
from fluxvla_core.checkpoints.checkpoint import Checkpoint, folders, newest_undamaged
from fluxvla_core.config.load import work_dirs_below
from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.training import InferenceDataset, Transform
from fluxvla_core.data.inference_dataset import PrivateInferenceDataset, try_preparation
from fluxvla_core.data.lerobot import camera_name
from fluxvla_core.data.mixture import first_dataset
from fluxvla_core.errors import CheckpointError, ConfigError, SpecMismatch, located
from fluxvla_core.plugins.registry import DATASETS, TRANSFORMS, VLAS, Registry
from fluxvla_core.policies.local import LocalPolicy
from fluxvla_core.spec import EmbodimentSpec
from fluxvla_core.training.input_sizes import (
    Declared,
    advice,
    declared_sizes,
    misfits,
    token_count,
    vocabulary_of,
)

log = logging.getLogger("fluxvla.policies")


def load_policy(
    ckpt_path: str | Path,
    device: str = "cpu",
    dataset: Any = None,
    denormalize_action: Any = None,
    mixed_precision_dtype: str = "float32",
    execution: str = "eager",
    quantization: str | None = None,
    check: Callable[[EmbodimentSpec, tuple[str, ...]], object] | None = None,
) -> LocalPolicy:
    """Build the policy that a checkpoint holds; its config is data and never executed.

    Args:
        ckpt_path: a checkpoint's folder, or a work dir, whose newest undamaged one is taken.
        device: a torch device; a plain ``cuda`` is ``own_device``'s.
        dataset: table or object that prepares observations instead of the training dataset's
            transforms (a ``PrivateInferenceDataset``); what it does not set,
            ``norm_stats`` and ``processors``, is the checkpoint's.
        denormalize_action: table or object instead of the inverse of the training's
            normalisation; ``norm_stats`` is the checkpoint's if it is not set.
        mixed_precision_dtype: ``float32`` or ``bf16``.
        execution: ``eager``, ``compiled`` (each block by ``torch.compile``) or ``graph`` (all
            denoising steps as one CUDA graph, on a GPU).
        quantization: ``int8``, ``fp8`` (weights of the blocks) or ``fp8_dynamic`` (their
            activations, too), by torchao.
        check: called before the model is built, with the robot that the policy was trained for and
            the names of the cameras that it looks at; what it raises ends the loading.

    Raises:
        CheckpointError: it is missing, damaged, or of another model.
        SpecMismatch: it does not say for which robot, or at which rate, its actions are; or its
            model does not take what its robot and its transforms give.
        ConfigError, PluginError: a part that its config names cannot be built here.
    """
    from fluxvla_core.policies.execution import check_execution
    from fluxvla_core.policies.inference_weights import check_quantization, ready

    check_execution(execution)
    check_quantization(quantization, device)
    checkpoint = Checkpoint.open(find_checkpoint(ckpt_path, Path(ckpt_path)))
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
    with located(where):
        prepare = _prepare(dataset, trained_on, checkpoint)
        denormalize = _denormalize(denormalize_action, prepare, checkpoint)
    own_objects = any(
        given is not None and not isinstance(given, Mapping)
        for given in (dataset, denormalize_action)
    )
    sizes = declared_sizes(config.get("model"))
    if not own_objects:  # somebody's own may count what they are asked
        batch = _try(prepare, denormalize, embodiment, int(facts["horizon"]), where)
        tokens = token_count(InferenceDataset.adapt(prepare).pipeline)
        _check_sizes(config.get("model"), sizes, batch, tokens, int(facts["horizon"]), where)
    keys = tuple(getattr(prepare, "img_keys", embodiment.camera_names))
    cameras = tuple(camera_name(key) for key in keys)
    if check is not None:
        check(embodiment, cameras)
    if device == "cuda":
        import torch

        device = own_device(os.environ, torch.cuda.device_count())
    model = ready(_model(checkpoint, device), mixed_precision_dtype, quantization)
    return LocalPolicy(
        model=model,
        prepare=prepare,
        denormalize=denormalize,
        embodiment=embodiment,
        cameras=cameras,
        action_rate_hz=float(facts["action_rate_hz"]),
        horizon=int(facts["horizon"]),
        device=device,
        precision=mixed_precision_dtype,
        source=where,
        execution=execution,
        vocabulary=vocabulary_of(sizes),
    )


def why_not_continued(ckpt_path: str | Path) -> str | None:
    """Why the model of a checkpoint cannot continue a chunk (``chunk_joining = "rtc"``).

    Found from its class, without its weights; None where nothing speaks against it.

    Raises:
        CheckpointError: there is no checkpoint, or it is damaged.
        PluginError: the model is of a plugin that is not installed.
    """
    table = Checkpoint.open(ckpt_path).config().get("model")
    if not isinstance(table, Mapping) or not isinstance(table.get("type"), str):
        return None
    predict = VLAS.get(table["type"]).predict_action
    if "prev_actions" in inspect.signature(predict).parameters:
        return None
    return (
        f"{table['type']} cannot continue a chunk: its predict_action() takes no prev_actions, "
        "which models of flow matching take"
    )


def own_device(environment: Mapping[str, str], count: int) -> str:
    """The torch device of this process: ranks on one machine share its GPUs evenly.

    Args:
        environment: the process's variables; torchrun sets ``LOCAL_RANK``, ``srun`` sets
            ``SLURM_LOCALID``.
        count: how many GPUs it sees.
    """
    local = environment.get("LOCAL_RANK", environment.get("SLURM_LOCALID"))
    return "cuda" if local is None or count < 1 else f"cuda:{int(local) % count}"


def find_checkpoint(ckpt_path: str | Path | None, work_dir: Path) -> Path:
    """The folder of the checkpoint to load, or of the newest undamaged one of a work dir.

    Args:
        ckpt_path: a checkpoint's folder, which is only opened here, or a work dir; None for
            ``work_dir``. A damaged checkpoint of a work dir is passed over with a warning.

    Raises:
        CheckpointError: there is none; the message describes damaged ones.
    """
    if ckpt_path is not None and not folders(ckpt_path):
        return Checkpoint.open(ckpt_path).path
    work_dir = work_dir if ckpt_path is None else Path(ckpt_path)
    found, refused = newest_undamaged(work_dir)
    if found is not None:
        for error in refused:
            log.warning("not loading a damaged checkpoint: %s: %s", error.where, error.what)
        return found.path
    damaged = "; ".join(error.what for error in refused)
    others = [shlex.quote(str(p)) for p in work_dirs_below(Path()) if folders(p)][:3]
    here = f", such as {' or '.join(others)}" if others else ""
    raise CheckpointError(
        f"there is no undamaged checkpoint in {work_dir}" + (f": {damaged}" if damaged else ""),
        next=f"train first (--section runner), or name the work dir of a training{here}: "
        f"--work-dir {others[0] if others else 'DIR'}",
    )


def _model(checkpoint: Checkpoint, device: str) -> Any:
    from fluxvla_core.training.weights import load_for_inference, model_of

    model = model_of(checkpoint)
    load_for_inference(model, checkpoint)
    return model.to(device).eval()


def _try(
    prepare: Any, denormalize: Any, robot: EmbodimentSpec, horizon: int, where: str
) -> Mapping[str, Any]:
    """The batch of a blank observation, made before weights are read; empty if the robot lacks a
    camera, which is reported by who drives it."""
    sizes = {camera.name: (camera.height, camera.width) for camera in robot.cameras}
    keys = getattr(prepare, "img_keys", ())
    if not all(camera_name(key) in sizes for key in keys):
        return {}
    chunk = (horizon, robot.dim)
    return try_preparation(prepare, denormalize, sizes, robot.state_dim, chunk, where)


def _check_sizes(
    table: Any,
    sizes: Mapping[str, Declared],
    batch: Mapping[str, Any],
    tokens: int,
    horizon: int,
    where: str,
) -> None:
    """Compare a checkpoint's ``model`` table with what it would be given, before it is built.

    Args:
        sizes: those that ``table`` declares.
        batch: a prepared observation.
        tokens: number of ids of its tokenizer, see ``token_count``.

    Raises:
        SpecMismatch: it takes something else; names the keys and both values.
    """
    wrong = misfits(table, batch, sizes, tokens=tokens)
    found = [f"model.{one.key}: {one.text}" for one in wrong]
    chunk = sizes.get("horizon")
    if chunk is not None and chunk.value != horizon:
        found.append(
            f"model.{chunk.key}: a chunk of the model has {chunk.value} actions, the horizon of "
            f"the checkpoint's policy.json is {horizon}"
        )
    if found:
        raise SpecMismatch(
            "\n  ".join(found),
            where=where,
            cause="its files belong to different trainings, or the section's dataset is not that "
            "of its training",
            next=advice(wrong) or None,
        )


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
        "no transform knows how actions were normalised",
        where=str(checkpoint.path),
        next="give the section denormalize_action = dict(type='DenormalizePrivateAction', ...)",
    )


def _taken(table: Any, registry: Registry, defaults: Mapping[str, Any]) -> dict[str, Any]:
    """The ``defaults`` for which the class that a table names has parameters."""
    if not isinstance(table, Mapping) or not isinstance(table.get("type"), str):
        return {}
    names = parameters(registry.get(table["type"]))
    return {key: value for key, value in defaults.items() if key in names}
