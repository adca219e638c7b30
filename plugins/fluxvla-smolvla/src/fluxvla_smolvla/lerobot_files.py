"""LeRobot's files of a SmolVLA: names of tensors, and processors with their statistics.

LeRobot 0.4 and later saves ``policy_preprocessor.json`` and ``policy_postprocessor.json``, lists of
steps; a step's tensors are in a safetensors file that it names (lerobot/processor/pipeline.py).
Earlier ones kept the statistics as buffers between the weights:
``normalize_inputs.buffer_observation_state.mean`` and so on
(lerobot/processor/migrate_policy_normalization.py).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fluxvla_models.lerobot_files import (
    ACTION,
    POSTPROCESSOR,
    PREPROCESSOR,
    STATE,
    full_tensor,
    read_steps,
)

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import Stored

_VLM = "model.vlm_with_expert.vlm."
PREFIXES = {
    "vision.layers.": f"{_VLM}model.vision_model.encoder.layers.",
    "vision.post_layernorm.": f"{_VLM}model.vision_model.post_layernorm.",
    "vision.": f"{_VLM}model.vision_model.embeddings.",
    "connector.proj.": f"{_VLM}model.connector.modality_projection.proj.",
    "text.": f"{_VLM}model.text_model.",
    "lm_head.": f"{_VLM}lm_head.",
    "expert.": "model.vlm_with_expert.lm_expert.",
    "embed_actions.": "model.",
    "state_proj.": "model.state_proj.",
    "action_out_proj.": "model.action_out_proj.",
}
"""Prefix of a name here -> prefix there; the first that fits counts."""
NORMS = {
    "MEAN_STD": "mean_std",
    "MIN_MAX": "min_max",
    "QUANTILES": "quantile",
    "QUANTILE10": "quantile10",
    "IDENTITY": "none",
}
"""LeRobot's normalisations -> those of ``SmolVLANormalize``."""
_KNOWN = {
    "normalizer_processor",
    "unnormalizer_processor",
    "rename_observations_processor",
    "tokenizer_processor",
    "to_batch_processor",
    "device_processor",
    "smolvla_new_line_processor",  # as SmolVLAPrompt
}
_BUFFERS = {
    "normalize_inputs.buffer_observation_state.": STATE,
    "normalize_targets.buffer_action.": ACTION,
    "unnormalize_outputs.buffer_action.": ACTION,
}
Statistics = dict[str, dict[str, list[float]]]
"""Feature -> statistic -> numbers, one for each dimension."""


def published(name: str) -> str:
    """LeRobot's name of the tensor that is ``name`` in ``SmolVLA().state_dict()``."""
    for ours, theirs in PREFIXES.items():
        if name.startswith(ours):
            return theirs + name.removeprefix(ours)
    raise KeyError(name)


def published_names(names: Iterable[str]) -> dict[str, str]:
    """``{name here: name there}`` of all tensors of a model."""
    return {name: published(name) for name in names}


@dataclass(frozen=True)
class Processors:
    """LeRobot's pre- and postprocessing of the model.

    Args:
        norms: ``STATE`` and ``ACTION`` -> the name of a normalisation.
        statistics: by feature; the action's are those that make physical actions.
        renamed: the robot's key of an observation -> the policy's.
        max_length: of the tokens; None if it does not say.
        tokenizer: the name of the tokenizer.
    """

    norms: Mapping[str, str] = field(default_factory=dict)
    statistics: Statistics = field(default_factory=dict)
    renamed: Mapping[str, str] = field(default_factory=dict)
    max_length: int | None = None
    tokenizer: str | None = None


def read_processors(folder: Path) -> Processors | None:
    """The processors that are saved in ``folder``; None if there are none.

    Raises:
        CheckpointError: they are damaged, or do something that is not known here.
    """
    if not (folder / f"{PREPROCESSOR}.json").is_file():
        return None
    norms: dict[str, str] = {}
    statistics: Statistics = {}
    renamed: dict[str, str] = {}
    tokens: Mapping[str, Any] = {}
    for stem in (PREPROCESSOR, POSTPROCESSOR):
        where = str(folder / f"{stem}.json")
        for step in read_steps(folder, stem, _KNOWN):
            name, settings = step.name, step.config
            if name in ("normalizer_processor", "unnormalizer_processor"):
                found = norms_of(settings.get("norm_map", {}), where)
                rows = _statistics(step.tensors)
                if stem == POSTPROCESSOR:  # it has a say on actions alone
                    found = {kind: norm for kind, norm in found.items() if kind == "ACTION"}
                    rows = {feature: row for feature, row in rows.items() if feature == ACTION}
                norms |= found
                statistics |= rows
            elif name == "rename_observations_processor":
                renamed |= _texts(settings.get("rename_map", {}), "rename_map", where)
            elif name == "tokenizer_processor":
                tokens = settings
    length, tokenizer = tokens.get("max_length"), tokens.get("tokenizer_name")
    for name, value, kind in (("max_length", length, int), ("tokenizer_name", tokenizer, str)):
        if value is not None and (not isinstance(value, kind) or isinstance(value, bool)):
            raise CheckpointError(f"{name} of the tokenizer's step is {value!r}", where=str(folder))
    return Processors(norms, statistics, renamed, length, tokenizer)


def buffered_statistics(tensors: Mapping[str, Stored]) -> Statistics:
    """Statistics that earlier versions kept between the weights."""
    found: Statistics = {}
    for name in tensors:
        for prefix, feature in _BUFFERS.items():
            if name.startswith(prefix):
                values = full_tensor(tensors[name]).float()
                # Infinite where nothing was ever set.
                if values.isfinite().all():
                    found.setdefault(feature, {})[name.removeprefix(prefix)] = values.tolist()
    return found


def norms_of(mapping: Mapping[str, Any], where: str) -> dict[str, str]:
    """State's and action's normalisation, from LeRobot's names.

    Raises:
        CheckpointError: an unknown normalisation, or one of images.
    """
    texts = _texts(mapping, "the mapping of normalisations", where)
    unknown = {kind: norm for kind, norm in texts.items() if norm not in NORMS}
    if unknown:
        kind, norm = next(iter(unknown.items()))
        raise CheckpointError(
            f"the normalisation {norm!r} of {kind} is not one of {', '.join(NORMS)}", where=where
        )
    if mapping.get("VISUAL", "IDENTITY") != "IDENTITY":
        raise CheckpointError(
            f"images are normalised by {mapping['VISUAL']}; SmolVLA takes them as they are "
            "(IDENTITY)",
            where=where,
        )
    return {kind: NORMS[norm] for kind, norm in mapping.items() if kind in ("STATE", "ACTION")}


def _texts(table: Any, what: str, where: str) -> dict[str, str]:
    if not isinstance(table, dict) or not all(isinstance(v, str) for v in table.values()):
        raise CheckpointError(f"{what} is no table of names: {table!r}", where=where)
    return table


def _statistics(tensors: Mapping[str, Stored]) -> Statistics:
    """Statistics of a step, flat as ``<feature>.<statistic>``."""
    found: Statistics = {}
    for name, stored in tensors.items():
        feature, _, statistic = name.rpartition(".")
        if feature in (STATE, ACTION) and statistic != "count":
            found.setdefault(feature, {})[statistic] = full_tensor(stored).float().tolist()
    return found
