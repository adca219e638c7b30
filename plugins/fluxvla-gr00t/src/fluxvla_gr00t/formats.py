"""The checkpoints that NVIDIA publishes, and its Isaac-GR00T saves, of GR00T N1.5 and N1.7."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch

from fluxvla_core import build_vla_from_cfg
from fluxvla_core.errors import CheckpointError, FluxError
from fluxvla_core.models import CheckpointFormat, ForeignCheckpoint, renamed, safetensors_in
from fluxvla_core.results import read_json
from fluxvla_gr00t.names import is_unread, published_name
from fluxvla_gr00t.robots import Robot, n15_robot, n17_robot

BACKBONES: dict[str, dict[str, Any]] = {
    "n1.5": {"type": "EagleBackbone"},
    "n1.7": {"type": "Qwen3VLBackbone"},
}
"""The backbones, whose sizes the files do not say."""
TOKENIZERS = {
    "n1.5": "lerobot/eagle2hg-processor-groot-n1p5",
    "n1.7": "nvidia/Cosmos-Reason2-2B",
}
"""Where the tokenizers are published; the checkpoints have none."""
_WORDS = 132
"""Tokens of a prompt besides the places of pictures: 900 in all for three pictures."""
_FIXED = {
    "add_pos_embed": True,
    "use_vlln": True,
    "num_timestep_buckets": 1000,
    "state_history_length": 1,
    "expand_batch": None,
    "exclude_state": False,
    "apply_sincos_state_encoding": False,
}
"""Settings that change what the model computes, and the values that are known here."""
_FIXED_DIT = {
    "norm_type": "ada_norm",
    "positional_embeddings": None,
    "interleave_self_attention": True,
}


class GR00TN15Format(CheckpointFormat):
    """Folders of GR00T N1.5: ``config.json``, ``model*.safetensors``, ``experiment_cfg``."""

    name: ClassVar[str] = "gr00t"
    model_types: ClassVar[tuple[str, ...]] = ("GR00T",)

    def recognizes(self, folder: Path) -> bool:
        """Whether its ``config.json`` is of GR00T N1.5."""
        return _model_type(folder) == "gr00t_n1_5"

    def read(self, folder: Path, tokenizer: str | None = None) -> ForeignCheckpoint:
        """The checkpoint in ``folder``.

        Args:
            tokenizer: the folder of Eagle's tokenizer.

        Raises:
            CheckpointError: it is damaged, or does something that GR00T here does not.
        """
        file = folder / "config.json"
        config = read_json(file, dict[str, Any], CheckpointError)
        robot = n15_robot(folder)
        settings = _Settings(config.get("action_head_cfg"), str(file))
        backbone = _Settings(config.get("backbone_cfg"), str(file))
        if backbone.get("project_to_dim") is not None:
            raise CheckpointError(
                f"backbone_cfg.project_to_dim is {backbone.get('project_to_dim')}, None is known",
                where=str(file),
            )
        head = {
            **_head(settings),
            "action_dim": settings.count("action_dim"),
            "future_tokens": settings.count("num_target_vision_tokens"),
        }
        model = _model("n1.5", backbone.count("select_layer"), head, robot)
        count = len(robot.img_keys)
        transforms: list[dict[str, Any]] = [
            {"type": "ListInstruction"},
            {
                "type": "ProcessPromptsWithImage",
                "max_len": count * _places(model) + _WORDS,
                "num_images": count,
                "fixed_img_tokens": _places(model),
                "tokenizer": _tokenizer("n1.5", tokenizer),
            },
            {"type": "ResizeImages", "height": _side(model), "width": _side(model)},
            {"type": "SimpleNormalizeImages"},
            _normalize(robot, head),
        ]
        return _checkpoint("n1.5", folder, model, transforms, robot)


class GR00TN17Format(CheckpointFormat):
    """Folders of GR00T N1.7: ``config.json``, ``model*.safetensors``, ``processor_config.json``,
    ``statistics.json`` and ``embodiment_id.json``."""

    name: ClassVar[str] = "gr00t"
    model_types: ClassVar[tuple[str, ...]] = ("GR00T",)

    def recognizes(self, folder: Path) -> bool:
        """Whether its ``config.json`` is of GR00T N1.7."""
        return _model_type(folder) == "Gr00tN1d7"

    def read(self, folder: Path, tokenizer: str | None = None) -> ForeignCheckpoint:
        """The checkpoint in ``folder``.

        Args:
            tokenizer: the folder of Qwen3-VL's tokenizer.

        Raises:
            CheckpointError: it is damaged, or does something that GR00T here does not.
        """
        file = folder / "config.json"
        settings = _Settings(read_json(file, dict[str, Any], CheckpointError), str(file))
        processing = folder / "processor_config.json"
        kwargs: Mapping[str, Any] = {"modality_configs": {}}
        if processing.is_file():
            content = read_json(processing, dict[str, Any], CheckpointError)
            kwargs = _Settings(content.get("processor_kwargs"), str(processing)).values
        robot = n17_robot(folder, kwargs)
        alternate = settings.get("use_alternate_vl_dit", True)
        head = {
            **_head(settings),
            "action_dim": settings.count("max_action_dim"),
            "future_tokens": 0,
            "attend_text_every": settings.count("attend_text_every_n_blocks")
            if alternate
            else None,
            "state_dropout": float(settings.get("state_dropout_prob", 0.0)),
        }
        model = _model("n1.7", settings.count("select_layer"), head, robot)
        resize = _resize({**settings.values, **kwargs}, str(processing))
        places = (resize["size"] // 32) ** 2
        transforms: list[dict[str, Any]] = [
            resize,
            {
                "type": "ProcessQwenPrompts",
                # Pictures that keep their aspect take more places than square ones.
                "max_len": len(robot.img_keys) * 2 * places + _WORDS,
                "formalize": bool(kwargs.get("formalize_language", True)),
                "tokenizer": _tokenizer("n1.7", tokenizer),
            },
            {"type": "SimpleNormalizeImages"},
            _normalize(robot, head),
        ]
        if kwargs.get("clip_outliers", True):
            transforms.append({"type": "ClipNormalized"})
        return _checkpoint("n1.7", folder, model, transforms, robot)


class _Settings:
    """Settings of a ``config.json``, read one by one."""

    def __init__(self, values: Any, where: str) -> None:
        if not isinstance(values, dict):
            raise CheckpointError("the settings of the model are no table", where=where)
        self.values: dict[str, Any] = values
        self.where = where

    def get(self, name: str, default: Any = None) -> Any:
        return self.values.get(name, default)

    def count(self, name: str) -> int:
        value = self.values.get(name)
        if not isinstance(value, int) or isinstance(value, bool):
            raise CheckpointError(
                f"{name} is {value!r}, a whole number is expected", where=self.where
            )
        return value

    def table(self, name: str) -> _Settings:
        return _Settings(self.values.get(name), self.where)

    def require(self, values: Mapping[str, Any]) -> None:
        for name, value in values.items():
            found = self.values.get(name, value)
            if found != value:
                raise CheckpointError(
                    f"{name} is {found!r}, {value!r} is known here",
                    where=self.where,
                    cause="the model computes something else than GR00T as it is built here",
                )


def _head(settings: _Settings) -> dict[str, Any]:
    """What both versions say of the head in the same words."""
    dit, context = settings.table("diffusion_model_cfg"), settings.table("vl_self_attention_cfg")
    settings.require(_FIXED)
    dit.require({**_FIXED_DIT, "output_dim": settings.count("hidden_size")})
    context.require({"positional_embeddings": None, "dropout": dit.get("dropout")})
    return {
        "type": "GR00TActionHead",
        "horizon": settings.count("action_horizon"),
        "state_dim": settings.count("max_state_dim"),
        "embodiments": settings.count("max_num_embodiments"),
        "layers": dit.count("num_layers"),
        "heads": dit.count("num_attention_heads"),
        "head_dim": dit.count("attention_head_dim"),
        "hidden_dim": settings.count("hidden_size"),
        "context_layers": context.count("num_layers"),
        "context_heads": context.count("num_attention_heads"),
        "max_steps": settings.count("max_seq_len"),
        "num_steps": settings.count("num_inference_timesteps"),
        "dropout": float(dit.get("dropout", 0.0)),
    }


def _model(version: str, layers: int, head: dict[str, Any], robot: Robot) -> dict[str, Any]:
    """The config's ``model`` table."""
    actions = robot.statistics.get("action")
    if actions is not None:
        head["ori_action_dim"] = int(_width(actions["mean"]))
    return {
        "type": "GR00T",
        "vlm_backbone": {**BACKBONES[version], "text_layers": layers},
        "vla_head": head,
        "embodiment_id": robot.embodiment_id,
    }


def _checkpoint(
    version: str,
    folder: Path,
    model: dict[str, Any],
    transforms: list[dict[str, Any]],
    robot: Robot,
) -> ForeignCheckpoint:
    horizon = int(model["vla_head"]["horizon"])
    notes = list(robot.notes)
    if robot.horizon is not None and robot.horizon < horizon:
        notes.append(
            f"of the {horizon} actions of a chunk {robot.horizon} were trained: execute no more"
        )
    statistics = {key: _padded(entry, horizon) for key, entry in robot.statistics.items()}
    with torch.device("meta"):
        own = build_vla_from_cfg(model).state_dict()
    stored = safetensors_in(folder)
    read = {name: stored[name] for name in stored if not is_unread(name, version)}
    return ForeignCheckpoint(
        model=model,
        tensors=renamed(read, {name: published_name(name, version) for name in own}, str(folder)),
        img_keys=robot.img_keys,
        transforms=transforms if statistics else (),
        statistics={"private": statistics},
        horizon=horizon,
        action_rate_hz=robot.rate,
        notes=tuple(notes),
    )


def _padded(entry: Mapping[str, list[Any]], horizon: int) -> dict[str, list[Any]]:
    """Statistics of one row a step, as long as a chunk: the last row is repeated."""
    return {
        name: values + [values[-1]] * (horizon - len(values))
        if values and isinstance(values[0], list)
        else values
        for name, values in entry.items()
    }


def _width(values: list[Any]) -> int:
    return len(values[0]) if isinstance(values[0], list) else len(values)


def _model_type(folder: Path) -> str | None:
    """``model_type`` of ``config.json``; None if there is none, or it is LeRobot's config."""
    try:
        config = read_json(folder / "config.json", dict[str, Any], CheckpointError)
    except FluxError:
        return None
    kind = config.get("model_type")
    return kind if isinstance(kind, str) and "type" not in config else None


def _tokenizer(version: str, place: str | None) -> dict[str, Any]:
    return {"type": "PretrainedTokenizer", "model_path": place or TOKENIZERS[version]}


def _normalize(robot: Robot, head: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "type": "NormalizeStatesAndActions",
        "state_dim": head["state_dim"],
        "action_dim": head["action_dim"],
        "norm_type": robot.norm_type,
    }


def _side(model: Mapping[str, Any]) -> int:
    return int(model["vlm_backbone"].get("image_size", 224))


def _places(model: Mapping[str, Any]) -> int:
    return (_side(model) // int(model["vlm_backbone"].get("patch_size", 14))) ** 2


def _resize(settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The transform of pictures, by N1.7's settings."""
    target, crop = settings.get("image_target_size"), settings.get("image_crop_size")
    target = [256, 256] if target is None else target
    fraction = settings.get("crop_fraction")
    if fraction is None:
        fraction = 1.0 if crop is None else crop[0] / target[0]
    if target[0] != target[1]:
        raise CheckpointError(f"image_target_size {target} is not square", where=where)
    return {
        "type": "ResizeCropImages",
        "size": int(target[0]),
        "shortest_edge": settings.get("shortest_image_edge"),
        "crop_fraction": float(fraction),
        "method": "area" if settings.get("use_albumentations") else "bicubic",
        "letter_box": bool(settings.get("letter_box_transform", False)),
    }
