"""PI0 as transformers saves it: ``PI0ForConditionalGeneration.save_pretrained``.

Its files name no camera, and its processor scales and pads images in another way than openpi and
LeRobot do, with which the model was made. So the weights are read, to be trained on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from fluxvla_models.lerobot_files import CONFIG

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import CheckpointFormat, ForeignCheckpoint, safetensors_in
from fluxvla_core.results import read_json
from fluxvla_pi.names import TRANSFORMERS, TRANSFORMERS_SAVED, layout_of
from fluxvla_pi.pi0 import PI0FlowMatching
from fluxvla_pi.published import KEY_HEADS, VISION_HEADS, weights_in

MODEL_TYPE = "pi0"
_FIXED: Mapping[tuple[str, ...], Any] = {
    ("min_period",): 4e-3,
    ("max_period",): 4.0,
    ("vlm_config", "text_config", "num_key_value_heads"): KEY_HEADS,
    ("dit_config", "num_key_value_heads"): KEY_HEADS,
    ("vlm_config", "vision_config", "num_attention_heads"): VISION_HEADS,
}
"""Settings that do not follow from shapes, and the values that are built here."""
_NOTE = (
    "transformers' files name no cameras, and its processor prepares images in another way than "
    "openpi and LeRobot: it can be trained on, and drives no robot"
)


class TransformersPi0Format(CheckpointFormat):
    """Folders of transformers' PI0; transformers itself is not needed."""

    name: ClassVar[str] = "transformers"
    model_types: ClassVar[Sequence[str]] = (PI0FlowMatching.__name__,)

    def recognizes(self, folder: Path) -> bool:
        """Whether its ``config.json`` says ``"model_type": "pi0"``, and is not LeRobot's."""
        try:
            config = read_json(folder / CONFIG, dict[str, Any], CheckpointError)
        except CheckpointError:
            return False
        return config.get("model_type") == MODEL_TYPE and "type" not in config

    def read(self, folder: Path, tokenizer: str | None = None) -> ForeignCheckpoint:
        """The weights in ``folder``, without transforms and statistics.

        Raises:
            CheckpointError: they are of another model, or the config of one that is not built here.
        """
        where = str(folder / CONFIG)
        config = read_json(folder / CONFIG, dict[str, Any], CheckpointError)
        for path, wanted in _FIXED.items():
            found = _setting(config, path, wanted)
            if found != wanted:
                raise CheckpointError(
                    f"{'.'.join(path)} is {found!r}; {wanted!r} is built here", where=where
                )
        weights = weights_in(folder)
        if layout_of(safetensors_in(folder), where) not in (TRANSFORMERS, TRANSFORMERS_SAVED):
            raise CheckpointError("the weights are not under transformers' names", where=where)
        horizon = _count(config, "chunk_size", 50, where)
        model = {
            **weights.model,
            "n_action_steps": horizon,
            "num_steps": _count(config, "num_inference_steps", 10, where),
        }
        return ForeignCheckpoint(
            model=model,
            tensors=weights.tensors,
            img_keys=(),
            transforms=(),
            statistics={"private": {}},
            horizon=horizon,
            notes=(_NOTE,),
        )


def _setting(config: Mapping[str, Any], path: Sequence[str], default: Any) -> Any:
    """A setting of a table in a table; ``default`` where one of them is left out."""
    found: Any = config
    for name in path:
        if not isinstance(found, Mapping):
            return default
        found = found.get(name, default if name == path[-1] else {})
    return found


def _count(config: Mapping[str, Any], name: str, default: int, where: str) -> int:
    value = config.get(name, default)
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise CheckpointError(f"{name} is {value!r}, not a number from 1", where=where)
    return value
