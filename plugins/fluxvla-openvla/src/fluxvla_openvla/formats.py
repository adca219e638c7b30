"""``OpenVLAFormat``: published folders of OpenVLA and OpenVLA-OFT."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from safetensors.torch import save_file
from torch import Tensor

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import (
    CheckpointFormat,
    ForeignCheckpoint,
    Stored,
    chosen_robot,
    safetensors_in,
    torch_table,
)
from fluxvla_openvla.folder import (
    BACKBONE,
    NATIVE,
    SIDECAR,
    STATISTICS,
    check_config,
    choose_statistics,
    is_native,
    language_table,
    platform_of,
    read_config,
    read_sidecar,
    read_statistics,
)
from fluxvla_openvla.names import (
    PARTS,
    film_name,
    flatten_native,
    is_buffer,
    merge_lora,
    part_name,
    published_film_name,
    with_lora,
)
from fluxvla_openvla.sizes import LanguageSize

_VISION = "vision_backbone"
_SUFFIX = "_checkpoint.pt"


class OpenVLAFormat(CheckpointFormat):
    """Reads and writes what the authors' code of OpenVLA and OpenVLA-OFT saves.

    That is a folder in Hugging Face's layout (``config.json`` with ``model_type`` ``openvla``,
    safetensors in parts, ``dataset_statistics.json``), with OpenVLA-OFT's own files next to it; or
    the native layout of a training, which is only read.
    """

    name: ClassVar[str] = "openvla"
    model_types: ClassVar[Sequence[str]] = ("OpenVLA", "OpenVLAOFT")

    def recognizes(self, folder: Path) -> bool:
        """By ``config.json``."""
        config = read_config(folder)
        if config is None:
            return False
        return config.get("model_type") == "openvla" or is_native(folder, config)

    def read(
        self, folder: Path, tokenizer: str | None = None, robot: str | None = None
    ) -> ForeignCheckpoint:
        """The checkpoint in ``folder``; nothing is read of safetensors before it is used.

        Args:
            tokenizer: not used: one comes with it.
            robot: the dataset whose statistics are meant, OpenVLA's ``unnorm_key``.

        Raises:
            CheckpointError: it is damaged, or of a model that is not built here.
            UsageError: it has no statistics of that dataset.
        """
        config, sidecar = read_config(folder) or {}, read_sidecar(folder)
        native = is_native(folder, config)
        check_config(config, folder)
        statistics = read_statistics(folder, config)
        chosen_robot(statistics, robot, str(folder))
        dataset, chosen = choose_statistics(
            statistics, sidecar.get("unnorm_key") if robot is None else robot, folder
        )
        parts = read_parts(folder)
        base = _native(folder / NATIVE) if native else _hugging_face(folder, _VISION in parts)
        tensors: dict[str, Any] = dict(base)
        for tensors_of_part in parts.values():
            tensors |= tensors_of_part
        model = _model(parts, sidecar, dataset, chosen, folder)
        model["language"] = language_table(config, native)
        model |= sidecar.get("model", {})
        oft = model["type"] == "OpenVLAOFT"
        platform = platform_of(dataset)
        cameras = platform.cameras if platform is not None and oft else ("image",)
        cameras = tuple(sidecar.get("img_keys", cameras))
        if oft:
            model.setdefault("num_images", len(cameras))
        rate = platform.rate_hz if platform is not None else None
        fine_tuned = oft or (dataset is not None and "libero" in dataset)
        return ForeignCheckpoint(
            model=model,
            tensors=tensors,
            img_keys=cameras,
            transforms=transforms(
                tokenizer_path(folder, tokenizer),
                bounds=sidecar.get(
                    "bounds", platform.bounds if platform is not None and oft else "quantile"
                ),
                states=bool(model.get("state_dim", 0)),
                gripper=sidecar.get("gripper", platform.gripper if platform is not None else None),
                crop=bool(sidecar.get("center_crop", fine_tuned)),
                resize=sidecar.get("interpolation", "lanczos" if fine_tuned else "bicubic"),
                size=int(model.get("image_size", 224)),
            ),
            statistics=chosen,
            horizon=int(model.get("horizon", 1)),
            action_rate_hz=sidecar.get("action_rate_hz", rate),
            notes=_notes(statistics, dataset, bool(parts), folder),
        )

    def write(self, checkpoint: ForeignCheckpoint, folder: Path) -> None:
        """Write Hugging Face's layout, OpenVLA-OFT's own files, and what they do not say."""
        tensors = {name: full_tensor(value) for name, value in checkpoint.tensors.items()}
        film = bool(checkpoint.model.get("use_film"))
        parts: dict[str, dict[str, Tensor]] = {}
        base: dict[str, Tensor] = {}
        for name, tensor in tensors.items():
            part, _, rest = name.partition(".")
            if part in PARTS:
                parts.setdefault(part, {})[rest] = tensor
            elif film and part == _VISION:
                parts.setdefault(part, {})[published_film_name(name)] = tensor
            else:
                base[name] = tensor.contiguous()
        save_file(base, folder / "model.safetensors", {"format": "pt"})
        if film:
            parts[_VISION] = with_lora(parts[_VISION])
        for part, content in parts.items():
            torch.save(content, folder / f"{part}--0{_SUFFIX}")
        _write_tables(checkpoint, folder)


def read_parts(folder: Path) -> dict[str, dict[str, Tensor]]:
    """OpenVLA-OFT's own files: part -> tensors by the names here.

    Raises:
        CheckpointError: there are several files of one part, or one is no table of tensors.
    """
    found: dict[str, dict[str, Tensor]] = {}
    for part in (*PARTS, _VISION):
        files = sorted(folder.glob(f"{part}--*{_SUFFIX}"))
        if len(files) > 1:
            raise CheckpointError(
                f"there are several files of {part}: {', '.join(file.name for file in files)}",
                where=str(folder),
                next="keep the one whose step the other files are of",
            )
        for file in files:
            content = _tensors(file)
            if part == _VISION:
                merged = merge_lora({film_name(n): t for n, t in content.items()}, str(file))
                found[part] = merged
            else:
                found[part] = {part_name(part, name): t for name, t in content.items()}
    return found


def transforms(
    tokenizer: str,
    bounds: str,
    states: bool,
    gripper: str | None,
    crop: bool,
    resize: str,
    size: int,
) -> list[dict[str, Any]]:
    """Tables of the transforms from an observation to a batch."""
    first = {"type": "ResizeOpenVLAImages", "size": size, "interpolation": resize}
    found: list[dict[str, Any]] = [first]
    if crop:
        found.append({"type": "CenterCropOpenVLAImages"})
    normalize = {"type": "NormalizeOpenVLA", "bounds": bounds, "states": states}
    if gripper is not None:
        normalize["gripper"] = gripper
    return [
        *found,
        {"type": "SimpleNormalizeImages"},
        normalize,
        {
            "type": "ProcessOpenVLAPrompts",
            "tokenizer": {"type": "PretrainedTokenizer", "model_path": tokenizer},
        },
    ]


def tokenizer_path(folder: Path, given: str | None) -> str:
    """``given``, or ``folder`` if it has a tokenizer.

    Raises:
        CheckpointError: neither.
    """
    if given is not None:
        return given
    if (folder / "tokenizer.json").is_file():
        return str(folder)
    raise CheckpointError(
        "the folder has no tokenizer.json",
        where=str(folder),
        next="copy Llama 2's tokenizer.json into it, or name its folder: --tokenizer DIR",
    )


def full_tensor(value: Tensor | Stored) -> Tensor:
    """All of a tensor that may still be in its file."""
    if isinstance(value, Stored):
        return value[tuple(slice(0, length) for length in value.shape)]
    return value


def _hugging_face(folder: Path, film: bool) -> dict[str, Any]:
    """The tensors of the safetensors files; with FiLM the vision backbone's are another file's."""
    stored = safetensors_in(folder)
    return {
        name: stored[name]
        for name in stored
        if not is_buffer(name) and not (film and name.startswith(f"{_VISION}."))
    }


def _native(file: Path) -> dict[str, Any]:
    content = torch_table(file)
    model = content.get("model")
    if not isinstance(model, Mapping):
        raise CheckpointError("it has no table 'model'", where=str(file))
    tensors = flatten_native(model, str(file))
    return {name: tensor for name, tensor in tensors.items() if not is_buffer(name)}


def _model(
    parts: Mapping[str, Mapping[str, Tensor]],
    sidecar: Mapping[str, Any],
    dataset: str | None,
    chosen: Mapping[str, Any],
    folder: Path,
) -> dict[str, Any]:
    """The model's table, by the shapes in OpenVLA-OFT's own files and by the dataset's name."""
    head = parts.get("action_head")
    if head is None:
        rows = chosen[next(iter(chosen))]["action"]
        return {"type": "OpenVLA", "action_dim": len(rows["q01"])}
    diffusion = any(name.startswith("action_head.noise_predictor.") for name in head)
    prefix = "action_head.noise_predictor.mlp_resnet" if diffusion else "action_head.model"
    last = head.get(f"{prefix}.fc2.weight")
    if last is None:
        raise CheckpointError(f"the action head has no {prefix}.fc2.weight", where=str(folder))
    platform = platform_of(dataset)
    horizon = sidecar.get("horizon", platform.horizon if platform is not None else None)
    if horizon is None:
        raise CheckpointError(
            f"how long a chunk is is not in the files, and the dataset's name {dataset!r} does not "
            "say either",
            where=str(folder),
            next=f'write it into {folder / SIDECAR}: {{"horizon": 8, "img_keys": ["image"]}}',
        )
    state = parts.get("proprio_projector", {}).get("proprio_projector.fc1.weight")
    return {
        "type": "OpenVLAOFT",
        "horizon": int(horizon),
        "action_dim": len(last),
        "state_dim": 0 if state is None else int(state.shape[1]),
        "head": "diffusion" if diffusion else "l1",
        "use_film": _VISION in parts,
    }


def _notes(
    statistics: Mapping[str, Any], dataset: str | None, oft: bool, folder: Path
) -> tuple[str, ...]:
    notes = []
    if dataset is None:
        notes.append(
            f"there are statistics of {len(statistics)} datasets: {', '.join(sorted(statistics))}; "
            "choose one by --robot NAME, or where the policy acts by statistic_name"
        )
    else:
        notes.append(f"actions are scaled by the statistics of {dataset!r}")
    if oft:
        notes.append("every token attends to every other one, as in the authors' code")
    return tuple(notes)


def _write_tables(checkpoint: ForeignCheckpoint, folder: Path) -> None:
    language = {**vars(LanguageSize()), **dict(checkpoint.model.get("language") or {})}
    stop = {"text_vocab_size", "stop_token"}
    config = {
        "model_type": "openvla",
        "architectures": ["OpenVLAForActionPrediction"],
        "vision_backbone_id": BACKBONE,
        "llm_backbone_id": "llama2-7b-pure",
        "arch_specifier": "no-align+fused-gelu-mlp",
        "image_resize_strategy": "resize-naive",
        "use_fused_vision_backbone": True,
        "n_action_bins": 256,
        "pad_token_id": language["text_vocab_size"],
        "pad_to_multiple_of": language["vocab_size"] - language["text_vocab_size"],
        "text_config": {
            "model_type": "llama",
            **{key: value for key, value in language.items() if key not in stop},
        },
    }
    known = {"type", "language", "pretrained_name_or_path"}
    normalize = _transform(checkpoint, "NormalizeOpenVLA") or {}
    resize = _transform(checkpoint, "ResizeOpenVLAImages") or {}
    sidecar: dict[str, Any] = {
        "img_keys": list(checkpoint.img_keys),
        "horizon": checkpoint.horizon,
        "interpolation": resize.get("interpolation", "bicubic"),
        "center_crop": _transform(checkpoint, "CenterCropOpenVLAImages") is not None,
        "bounds": normalize.get("bounds", "quantile"),
        "gripper": normalize.get("gripper"),
        "model": {key: value for key, value in checkpoint.model.items() if key not in known},
    }
    if checkpoint.action_rate_hz is not None:
        sidecar["action_rate_hz"] = checkpoint.action_rate_hz
    for name, table in (
        ("config.json", config),
        (STATISTICS, _with_mask(checkpoint.statistics, normalize.get("action_mask"))),
        (SIDECAR, sidecar),
    ):
        (folder / name).write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


def _transform(checkpoint: ForeignCheckpoint, name: str) -> Mapping[str, Any] | None:
    """The table of the transform ``name``, which may be named with its distribution."""
    tables = (t for t in checkpoint.transforms if str(t.get("type")).rpartition(":")[2] == name)
    return next(tables, None)


def _with_mask(statistics: Mapping[str, Any], mask: Sequence[bool] | None) -> dict[str, Any]:
    """``statistics`` with the mask of actions where their file has it."""
    if mask is None:
        return dict(statistics)
    return {
        name: {**entry, "action": {**entry["action"], "mask": list(mask)}}
        for name, entry in statistics.items()
    }


def _tensors(file: Path) -> dict[str, Tensor]:
    content = torch_table(file)
    others = [name for name, value in content.items() if not isinstance(value, Tensor)]
    if others:
        raise CheckpointError(f"{others[0]!r} is not a tensor", where=str(file))
    return content
