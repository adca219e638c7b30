"""``LeRobotSmolVLA``: the checkpoints that LeRobot publishes of SmolVLA."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from math import isqrt
from pathlib import Path
from typing import Any, ClassVar

from fluxvla_models.lerobot_files import (
    ACTION,
    BUFFERS,
    STATE,
    check_both,
    check_policy_settings,
    policy_type,
)

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import (
    CheckpointFormat,
    ForeignCheckpoint,
    Stored,
    renamed,
    safetensors_in,
    without_cameras,
)
from fluxvla_core.results import read_json
from fluxvla_smolvla.lerobot_files import (
    Processors,
    buffered_statistics,
    norms_of,
    published,
    published_names,
    read_processors,
)
from fluxvla_smolvla.lerobot_write import write
from fluxvla_smolvla.model import SMOLVLM2, SmolVLA

MODEL_TYPE = "smolvla"
HEAD_DIM = 64
"""Width of an attention head in SmolLM2 of every size, and in SigLIP's base model."""
VISION_HEADS = {1152: 16}
"""Width of a vision tower -> its heads, where they are not ``HEAD_DIM`` wide: SigLIP so400m."""
COMPILED = "model._orig_mod."
"""Prefix of names if the policy was compiled when it was saved."""
UNSUPPORTED = {
    "adapt_to_pi_aloha": (False, "its joints and grippers are those of pi0's ALOHA"),
    "use_delta_joint_actions_aloha": (False, "its actions are differences"),
    "add_image_special_tokens": (False, "tokens stand around its images"),
    "use_peft": (False, "it is an adapter for other weights"),
    "n_obs_steps": (1, "it looks at several frames"),
}
"""Settings that change what the model computes, and the values that are known here."""
SETTINGS = (
    *UNSUPPORTED,
    "max_state_dim",
    "max_action_dim",
    "resize_imgs_with_padding",
    "empty_cameras",
    "tokenizer_max_length",
    "num_steps",
    "use_cache",
    "vlm_model_name",
    "load_vlm_weights",
    "attention_mode",
    "prefix_length",
    "pad_language_to",
    "num_expert_layers",
    "num_vlm_layers",
    "self_attn_every_n_layers",
    "expert_width_multiplier",
    "min_period",
    "max_period",
    "rtc_config",
)
"""Its own names of settings in LeRobot's config."""
_EMPTY = re.compile(r"empty_camera_\d+$")


class LeRobotSmolVLA(CheckpointFormat):
    """Folders of LeRobot's ``save_pretrained``, with processors or, from before them, without."""

    name: ClassVar[str] = "lerobot"
    model_types: ClassVar[tuple[str, ...]] = ("SmolVLA",)

    def recognizes(self, folder: Path) -> bool:
        """Whether its ``config.json`` says ``"type": "smolvla"``."""
        return policy_type(folder) == MODEL_TYPE

    def read(
        self, folder: Path, tokenizer: str | None = None, absent: Sequence[str] = ()
    ) -> ForeignCheckpoint:
        """The checkpoint in ``folder``.

        Args:
            tokenizer: the folder of SmolVLM2's tokenizer, which LeRobot fetches from the hub.
            absent: cameras without images, which LeRobot leaves out.

        Raises:
            CheckpointError: it is damaged, or does something that SmolVLA here does not.
            UsageError: it has no such camera.
        """
        where = str(folder / "config.json")
        config = Settings(read_json(folder / "config.json", dict[str, Any], CheckpointError), where)
        config.refuse_unsupported()
        check_policy_settings(config.content, SETTINGS, where)
        stored = safetensors_in(folder)
        weights = {
            name.replace(COMPILED, "model.", 1): tensor
            for name, tensor in stored.items()
            if not name.startswith(BUFFERS)
        }
        vision, text = vision_table(weights, where), text_table(weights, where)
        config.check_size(vision["image_size"], text["layers"])
        processors = read_processors(folder)
        notes = []
        if processors is None:
            statistics = buffered_statistics(stored)
            norms = norms_of(config.table("normalization_mapping"), where)
            processors = Processors(norms, statistics)
        bare = {kind for kind, norm in processors.norms.items() if norm == "none"}
        check_both(
            {
                feature: processors.statistics.get(feature)
                for feature, kind in ((STATE, "STATE"), (ACTION, "ACTION"))
                if kind not in bare
            },
            str(folder),
        )
        if not processors.statistics and bare != {"STATE", "ACTION"}:
            notes.append("it has no statistics: it can be trained on, and drives no robot")
        steps, executed = config.count("chunk_size", 50), config.count("n_action_steps", 50)
        if executed < steps:
            notes.append(f"LeRobot executes {executed} of its {steps} actions: execute_horizon")
        every, empty = config.cameras(processors.renamed)
        cameras = without_cameras(every, absent, where)
        model = config.model(vision, text)
        names = published_names(_names(model))
        return ForeignCheckpoint(
            model=model,
            tensors=renamed(weights, names, str(folder)),
            img_keys=cameras,
            transforms=config.transforms(
                processors, vision["image_size"], len(cameras), empty, _tokenizer(folder, tokenizer)
            ),
            statistics={"private": config.statistics(processors)},
            horizon=steps,
            notes=tuple(notes),
        )

    def write(self, checkpoint: ForeignCheckpoint, folder: Path) -> None:
        """Write it as LeRobot 0.6 saves a policy with its processors.

        Raises:
            CheckpointError: its transforms are not those that LeRobot has.
        """
        write(checkpoint, folder)


class Settings:
    """A ``config.json`` of LeRobot's, read key by key."""

    def __init__(self, content: Mapping[str, Any], where: str) -> None:
        self.content, self.where = content, where

    def count(self, name: str, default: int) -> int:
        """A whole number."""
        value = self.content.get(name, default)
        if not isinstance(value, int) or isinstance(value, bool):
            raise self._wrong(name, value, "a whole number")
        return value

    def number(self, name: str, default: float) -> float:
        value = self.content.get(name, default)
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise self._wrong(name, value, "a number")
        return float(value)

    def text(self, name: str, default: str) -> str:
        value = self.content.get(name, default)
        if not isinstance(value, str):
            raise self._wrong(name, value, "a text")
        return value

    def table(self, name: str) -> Mapping[str, Any]:
        value = self.content.get(name, {})
        if not isinstance(value, dict):
            raise self._wrong(name, value, "a table")
        return value

    def refuse_unsupported(self) -> None:
        """Refuse settings under which the model computes something else.

        Raises:
            CheckpointError: names the setting and both values.
        """
        for name, (known, why) in UNSUPPORTED.items():
            value = self.content.get(name, known)
            if value != known:
                raise CheckpointError(
                    f"{name} is {value!r}, {known!r} is known here", where=self.where, cause=why
                )

    def check_size(self, image_size: int, layers: int) -> None:
        """Compare with the weights what the config says of them."""
        resized = self.content.get("resize_imgs_with_padding", [512, 512])
        if resized != [image_size, image_size]:
            raise CheckpointError(
                f"resize_imgs_with_padding is {resized}, the vision tower is for "
                f"{[image_size, image_size]}",
                where=self.where,
            )
        if self.count("num_vlm_layers", 16) not in (layers, 0, -1):
            raise CheckpointError(
                f"num_vlm_layers is {self.content['num_vlm_layers']}, the weights have {layers}",
                where=self.where,
            )

    def cameras(self, robot_keys: Mapping[str, str]) -> tuple[tuple[str, ...], int]:
        """Names of the cameras in the model's order, and how many are always empty."""
        features = self.table("input_features")
        for key, value in features.items():
            if not isinstance(value, dict):
                raise self._wrong(f"input_features.{key}", value, "a table")
        keys = [key for key, value in features.items() if value.get("type") == "VISUAL"]
        present = [key for key in keys if not _EMPTY.search(key)]
        if not present:
            raise CheckpointError("input_features: there is no camera", where=self.where)
        back = {theirs: ours for ours, theirs in robot_keys.items()}
        names = (back.get(key, key) for key in present)
        return (
            tuple(
                n.removeprefix("observation.images.").removeprefix("observation.") for n in names
            ),
            self.count("empty_cameras", 0),
        )

    def model(self, vision: Mapping[str, Any], text: Mapping[str, Any]) -> dict[str, Any]:
        """The ``model`` table."""
        experts = self.count("num_expert_layers", -1)
        crosses = "cross" in self.text("attention_mode", "cross_attn")
        every = self.count("self_attn_every_n_layers", 2) if crosses else 1
        return {
            "type": "SmolVLA",
            "vision": dict(vision),
            "text": dict(text),
            "n_action_steps": self.count("chunk_size", 50),
            "max_state_dim": self.count("max_state_dim", 32),
            "max_action_dim": self.count("max_action_dim", 32),
            "ori_action_dim": self._action_dim(),
            "num_steps": self.count("num_steps", 10),
            "num_expert_layers": experts if experts > 0 else None,
            "self_attn_every_n_layers": max(every, 0),
            "expert_width_multiplier": self.number("expert_width_multiplier", 0.75),
            "min_period": self.number("min_period", 4e-3),
            "max_period": self.number("max_period", 4.0),
            "vlm_model_name": self.text("vlm_model_name", SMOLVLM2),
        }

    def transforms(
        self,
        processors: Processors,
        image_size: int,
        cameras: int,
        empty: int,
        tokenizer: str | None,
    ) -> tuple[dict[str, Any], ...]:
        """Tables of the transforms from an observation to a batch."""
        images: dict[str, Any] = {"type": "SmolVLAImages", "empty_cameras": empty}
        if cameras > 1:  # they may be of different sizes
            images |= {"height": image_size, "width": image_size}
        path = tokenizer or processors.tokenizer or self.text("vlm_model_name", SMOLVLM2)
        return (
            images,
            {
                "type": "SmolVLANormalize",
                "state_dim": self.count("max_state_dim", 32),
                "action_dim": self.count("max_action_dim", 32),
                "state_norm": processors.norms.get("STATE", "none"),
                "action_norm": processors.norms.get("ACTION", "none"),
            },
            {"type": "SmolVLAPrompt"},
            {
                "type": "ProcessPrompts",
                "tokenizer": {"type": "PretrainedTokenizer", "model_path": path},
                "max_len": processors.max_length or self.count("tokenizer_max_length", 48),
            },
        )

    def statistics(self, processors: Processors) -> dict[str, Any]:
        """Our entries; where nothing is normalised, zeros and ones of the same width."""
        found: dict[str, Any] = {}
        for feature, kind, entry, section in (
            (STATE, "STATE", "proprio", "input_features"),
            (ACTION, "ACTION", "action", "output_features"),
        ):
            rows = dict(processors.statistics.get(feature, {}))
            if processors.norms.get(kind, "none") == "none" and not rows:
                width = self._width(section, feature)
                if width is not None:
                    rows = {"mean": [0.0] * width, "std": [1.0] * width}
            if rows:
                found[entry] = rows
        return found

    def _action_dim(self) -> int | None:
        return self._width("output_features", ACTION)

    def _width(self, section: str, name: str) -> int | None:
        feature = self.table(section).get(name, {})
        shape = feature.get("shape") if isinstance(feature, dict) else feature
        if shape is None:
            return None
        if not isinstance(shape, list) or len(shape) != 1 or not isinstance(shape[0], int):
            raise self._wrong(f"{section}.{name}.shape", shape, "one whole number")
        return shape[0]

    def _wrong(self, name: str, value: Any, expected: str) -> CheckpointError:
        return CheckpointError(f"{name} is {value!r}, {expected} is expected", where=self.where)


def vision_table(weights: Mapping[str, Stored], where: str) -> dict[str, int]:
    """The vision tower's size, from the shapes of its weights."""
    width, _, patch, _ = _shape(weights, "vision.patch_embedding.weight", 4, where)
    inner, _ = _shape(weights, "vision.layers.0.mlp.fc1.weight", 2, where)
    places, _ = _shape(weights, "vision.position_embedding.weight", 2, where)
    _, joined = _shape(weights, "connector.proj.weight", 2, where)
    return {
        "hidden_size": width,
        "intermediate_size": inner,
        "layers": _layers(weights, "vision.layers."),
        "heads": VISION_HEADS.get(width, width // HEAD_DIM),
        "image_size": isqrt(places) * patch,
        "patch_size": patch,
        "scale_factor": isqrt(joined // width),
    }


def text_table(weights: Mapping[str, Stored], where: str) -> dict[str, int]:
    """The language model's size, from the shapes of its weights."""
    vocabulary, width = _shape(weights, "text.embed_tokens.weight", 2, where)
    inner, _ = _shape(weights, "text.layers.0.mlp.gate_proj.weight", 2, where)
    queries, _ = _shape(weights, "text.layers.0.self_attn.q_proj.weight", 2, where)
    keys, _ = _shape(weights, "text.layers.0.self_attn.k_proj.weight", 2, where)
    return {
        "hidden_size": width,
        "intermediate_size": inner,
        "layers": _layers(weights, "text.layers."),
        "heads": queries // HEAD_DIM,
        "kv_heads": keys // HEAD_DIM,
        "head_dim": HEAD_DIM,
        "vocabulary": vocabulary,
    }


def _shape(weights: Mapping[str, Stored], ours: str, ndim: int, where: str) -> tuple[int, ...]:
    name = published(ours)
    if name not in weights or len(weights[name].shape) != ndim:
        found = tuple(weights[name].shape) if name in weights else "missing"
        raise CheckpointError(f"{name} is {found}; {ndim} dimensions are expected", where=where)
    return tuple(weights[name].shape)


def _layers(weights: Mapping[str, Stored], ours: str) -> int:
    prefix = published(ours)
    found = {name.removeprefix(prefix).partition(".")[0] for name in weights if prefix in name}
    return len(found)


def _names(model: Mapping[str, Any]) -> list[str]:
    """Names of the model's tensors; it is built without memory for them."""
    import torch

    with torch.device("meta"):
        return list(SmolVLA(**{k: v for k, v in model.items() if k != "type"}).state_dict())


def _tokenizer(folder: Path, given: str | None) -> str | None:
    if given is None and (folder / "tokenizer.json").is_file():
        return str(folder)
    return given
