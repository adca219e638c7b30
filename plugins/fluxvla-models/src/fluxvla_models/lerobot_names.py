"""Names of the tensors of LeRobot's ACT and Diffusion Policy, and of ours.

Each function takes LeRobot's name and gives ours; None for what is no weight: tables of positions
that follow from the architecture, and statistics that older versions kept among the weights.
"""

from __future__ import annotations

import re

from fluxvla_models.lerobot_files import BUFFERS

_NETWORK = {
    "0": "conv1",
    "1": "bn1",
    "4": "layer1",
    "5": "layer2",
    "6": "layer3",
    "7": "layer4",
}
"""Places in LeRobot's sequence of a residual network's parts (2 and 3 have no weights)."""
_PLACES = {part: place for place, part in _NETWORK.items()}
_BACKBONE = re.compile(r"^(rgb_encoders\.\d+\.backbone\.)(\d+)\.")
_OWN_BACKBONE = re.compile(r"^(rgb_encoders\.\d+\.backbone\.)(\w+)\.")


def act_name(name: str) -> str | None:
    """``model.encoder.…`` -> ``encoder.…``."""
    if name.startswith(BUFFERS) or name == "model.vae_encoder_pos_enc":
        return None
    return name.removeprefix("model.")


def diffusion_name(name: str) -> str | None:
    """``diffusion.rgb_encoder.0.backbone.4.0.conv1.weight`` ->
    ``rgb_encoders.0.backbone.layer1.0.conv1.weight``; a shared encoder is number 0."""
    if name.startswith(BUFFERS) or name.endswith(".pool.pos_grid"):
        return None
    own_name = name.removeprefix("diffusion.")
    if own_name.startswith("rgb_encoder."):
        rest = own_name.removeprefix("rgb_encoder.")
        own_name = f"rgb_encoders.{rest}" if rest[0].isdigit() else f"rgb_encoders.0.{rest}"
    place = _BACKBONE.match(own_name)
    if place is None or place[2] not in _NETWORK:
        return own_name
    return f"{place[1]}{_NETWORK[place[2]]}.{own_name[place.end() :]}"


def published_act_name(name: str) -> str:
    """``encoder.…`` -> ``model.encoder.…``: of our ``name`` LeRobot's."""
    return f"model.{name}"


def published_diffusion_name(name: str, separate: bool) -> str:
    """LeRobot's name of our tensor ``name``; ``separate``: each camera has its own encoder."""
    part = _OWN_BACKBONE.match(name)
    if part is not None and part[2] in _PLACES:
        name = f"{part[1]}{_PLACES[part[2]]}.{name[part.end() :]}"
    if not separate:
        name = re.sub(r"^rgb_encoders\.0\.", "rgb_encoder.", name)
    return f"diffusion.{re.sub(r'^rgb_encoders', 'rgb_encoder', name)}"
