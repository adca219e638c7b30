"""Contents of a published folder besides its tensors: sizes, statistics, robot.

OpenVLA-OFT's files do not say how long a chunk is, how many images there are, or which of
several statistics are meant: its code takes them from words of the command line. A folder may hold
``fluxvla_openvla.json`` that says so, with any of these keys:

* ``unnorm_key``: which entry of the statistics;
* ``img_keys``: cameras, in the model's order;
* ``horizon``, ``action_rate_hz``: of a chunk;
* ``interpolation``, ``center_crop``: how images are resized, and whether the middle 0.9 of them
  is cut out, as after training with augmentation;
* ``bounds``, ``gripper``: of ``NormalizeOpenVLA``;
* ``model``: a table that goes over the model's (sizes of other towers).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluxvla_core.errors import CheckpointError
from fluxvla_core.results import read_json

SIDECAR = "fluxvla_openvla.json"
STATISTICS = "dataset_statistics.json"
NATIVE = Path("checkpoints", "latest-checkpoint.pt")
BACKBONE = "dinosiglip-vit-so-224px"
_KEYS = (
    "unnorm_key",
    "img_keys",
    "horizon",
    "action_rate_hz",
    "interpolation",
    "center_crop",
    "bounds",
    "gripper",
    "model",
)


_SAVED = ("architectures", "auto_map", "dtype", "torch_dtype", "transformers_version", "use_cache")
"""What transformers writes into any model's config."""
_SETTINGS = (
    *_SAVED,
    "model_type",
    "vision_backbone_id",
    "llm_backbone_id",
    "arch_specifier",
    "use_fused_vision_backbone",
    "timm_model_ids",
    "timm_override_act_layers",
    "image_sizes",
    "image_resize_strategy",
    "hf_llm_id",
    "llm_max_length",
    "pad_token_id",
    "pad_to_multiple_of",
    "text_config",
    "output_projector_states",
    "norm_stats",
    "n_action_bins",
)
_LANGUAGE = (
    "hidden_size",
    "intermediate_size",
    "num_hidden_layers",
    "num_attention_heads",
    "num_key_value_heads",
    "vocab_size",
    "rms_norm_eps",
    "rope_theta",
    "max_position_embeddings",
)
"""Settings of the language model that are read, and below those that change no number here."""
_LANGUAGE_UNREAD = (
    *_SAVED,
    "model_type",
    "head_dim",
    "hidden_act",
    "initializer_range",
    "pretraining_tp",
    "rope_parameters",
    "attention_dropout",
    "pad_token_id",
    "bos_token_id",
    "eos_token_id",
    "return_dict",
)


@dataclass(frozen=True)
class Platform:
    """What OpenVLA-OFT's code takes for a robot (``prismatic/vla/constants.py``).

    Args:
        horizon: actions in a chunk.
        cameras: third-person one first.
        bounds: of the normalisation.
        rate_hz: actions a second.
        gripper: see ``NormalizeOpenVLA``.
    """

    horizon: int
    cameras: tuple[str, ...]
    bounds: str
    rate_hz: float
    gripper: str | None = None


PLATFORMS: Mapping[str, Platform] = {
    "libero": Platform(8, ("image", "wrist_image"), "quantile", 20.0, "libero"),
    "aloha": Platform(25, ("image", "left_wrist_image", "right_wrist_image"), "min_max", 25.0),
    "bridge": Platform(5, ("image",), "quantile", 5.0),
}
"""By a word in the name of the dataset."""


def platform_of(dataset: str | None) -> Platform | None:
    """The platform whose word is in ``dataset``; None if there is none."""
    found = (p for word, p in PLATFORMS.items() if dataset is not None and word in dataset.lower())
    return next(found, None)


def read_config(folder: Path) -> dict[str, Any] | None:
    """``config.json`` if it is a table; None if there is none."""
    try:
        return read_json(folder / "config.json", dict[str, Any], CheckpointError)
    except CheckpointError:
        return None


def is_native(folder: Path, config: Mapping[str, Any]) -> bool:
    """Whether ``folder`` is a training of Prismatic's code."""
    vla = config.get("vla")
    return isinstance(vla, Mapping) and "base_vlm" in vla and (folder / NATIVE).is_file()


def read_sidecar(folder: Path) -> dict[str, Any]:
    """``fluxvla_openvla.json``, empty if there is none.

    Raises:
        CheckpointError: it is not JSON, or has other keys.
    """
    file = folder / SIDECAR
    if not file.is_file():
        return {}
    found = read_json(file, dict[str, Any], CheckpointError)
    unknown = sorted(set(found) - set(_KEYS))
    if unknown:
        raise CheckpointError(
            f"unknown key {unknown[0]!r}; known are {', '.join(_KEYS)}", where=str(file)
        )
    return found


def read_statistics(folder: Path, config: Mapping[str, Any]) -> dict[str, Any]:
    """All statistics of the folder, by dataset: its file's, or else its config's ``norm_stats``.

    Raises:
        CheckpointError: there are none.
    """
    file = folder / STATISTICS
    there = file.is_file()
    found = read_json(file, dict[str, Any], CheckpointError) if there else config.get("norm_stats")
    if (
        not isinstance(found, dict)
        or not found
        or not all(
            isinstance(v, dict) and isinstance(v.get("action"), dict) for v in found.values()
        )
    ):
        raise CheckpointError(
            f"there are no statistics of actions, neither in {STATISTICS} nor in config.json",
            where=str(folder),
            next="copy the training's dataset_statistics.json into the folder",
        )
    return found


def choose_statistics(
    statistics: Mapping[str, Any], wanted: str | None, folder: Path
) -> tuple[str | None, dict[str, Any]]:
    """The statistics under the names that a policy looks for them by.

    Returns:
        The dataset's name and ``{"private": its entry}``; or None and all entries under their own
        names, where there are several and none was chosen.

    Raises:
        CheckpointError: there is no entry ``wanted``; lists those there are.
    """
    if wanted is not None and wanted not in statistics:
        raise CheckpointError(
            f"unnorm_key {wanted!r} is not in the statistics; they have "
            f"{', '.join(sorted(statistics))}",
            where=str(folder / SIDECAR),
        )
    if wanted is None and len(statistics) > 1:
        return None, {name: _entry(entry) for name, entry in statistics.items()}
    name = wanted if wanted is not None else next(iter(statistics))
    return name, {"private": _entry(statistics[name])}


def language_table(config: Mapping[str, Any], native: bool) -> dict[str, Any]:
    """The table ``language`` of the model: what the config's ``text_config`` sets."""
    if native:
        # Llama 2's own config.json, which that code loads, has another epsilon.
        return {"rms_norm_eps": 1e-5}
    text = config.get("text_config")
    given = text if isinstance(text, Mapping) else {}
    table = {key: given[key] for key in _LANGUAGE if key in given}
    padding = config.get("pad_to_multiple_of", 64)
    table["text_vocab_size"] = table.get("vocab_size", 32064) - padding
    return table


def check_config(config: Mapping[str, Any], folder: Path) -> None:
    """Refuse other towers than DINOv2 and SigLIP at 224 pixels, and other images or bins.

    Raises:
        CheckpointError: with what the config says.
    """
    from fluxvla_core.models import check_settings  # imports torch

    where = str(folder / "config.json")
    if not is_native(folder, config):
        check_settings(config, _SETTINGS, where)
        text = config.get("text_config")
        if isinstance(text, Mapping):
            check_settings(text, (*_LANGUAGE, *_LANGUAGE_UNREAD), f"{where}: text_config")
            if text.get("hidden_act", "silu") != "silu":
                raise CheckpointError(
                    f"text_config.hidden_act is {text['hidden_act']!r}; only 'silu' is built here",
                    where=where,
                )
    for key, built in (
        ("vision_backbone_id", BACKBONE),
        ("image_resize_strategy", "resize-naive"),
        ("n_action_bins", 256),
    ):
        found = config.get(key, built)
        if found != built:
            raise CheckpointError(
                f"{key} is {found!r}; only {built!r} is built here",
                where=where,
            )


def _entry(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {key: entry[key] for key in ("proprio", "action") if key in entry}
