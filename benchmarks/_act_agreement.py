"""Whether ``_act_model.py`` is LeRobot's ``act``: equal weights, equal actions, loss, gradients.

    python _act_agreement.py DATASET FOLDER        LeRobot's half, in LeRobot's environment

Dropout is off and the latent's noise is left out, for each side draws its own; half of the chunks
end early, as at the end of an episode.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest import mock

import torch
from torch import Tensor

if TYPE_CHECKING:
    from tools.envs import Env

BATCH, CHUNK = 4, 100
# In this order: what LeRobot calls it -> what _act_model.py does.
NAMES = (
    (r"\bvae_encoder\.layers\.", "action_encoder."),
    (r"\b(en|de)coder\.layers\.", r"\1coder."),
    (r"\bdecoder\.norm\.", "decoder_norm."),
    (r"\bself_attn\.out_proj", "own.out"),
    (r"\bmultihead_attn\.out_proj", "memory.out"),
    (r"\bself_attn\.", "own."),
    (r"\bmultihead_attn\.", "memory."),
    (r"\blinear1\.", "feed.up."),
    (r"\blinear2\.", "feed.down."),
    (r"\bvae_encoder_cls_embed\.", "style."),
    (r"\bvae_encoder_robot_state_input_proj\.", "style_state."),
    (r"\bvae_encoder_action_input_proj\.", "style_action."),
    (r"\bvae_encoder_latent_output_proj\.", "style_latent."),
    (r"\bvae_encoder_pos_enc$", "style_places"),
    (r"\bencoder_robot_state_input_proj\.", "state."),
    (r"\bencoder_latent_input_proj\.", "from_latent."),
    (r"\bencoder_img_feat_input_proj\.", "image_proj."),
    (r"\bencoder_1d_feature_pos_embed\.", "token_places."),
    (r"\bdecoder_pos_embed\.", "queries."),
    (r"\baction_head\.", "head."),
    (r"\.downsample\.0\.", ".shortcut."),
    (r"\.downsample\.1\.", ".shortcut_bn."),
    (r"\bbackbone\.conv1\.", "backbone.stem."),
    (r"\bbackbone\.bn1\.", "backbone.stem_bn."),
    (r"\.bn(\d)\.", r".conv\1_bn."),
)


def ours(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """LeRobot's weights, or their gradients, by our names: projections apart, norms folded."""
    found: dict[str, Tensor] = {}
    norms: dict[str, dict[str, Tensor]] = {}
    for name, value in state.items():
        key = name.removeprefix("model.")
        for pattern, text in NAMES:
            key = re.sub(pattern, text, key)
        key = re.sub(r"\bnorm(\d)\.", lambda m: f"norms.{int(m[1]) - 1}.", key)
        key = re.sub(
            r"\blayer(\d)\.(\d)\.", lambda m: f"blocks.{2 * int(m[1]) - 2 + int(m[2])}.", key
        )
        place, _, last = key.rpartition(".")
        if last in ("in_proj_weight", "in_proj_bias"):
            for part, piece in zip(("query", "key", "value"), value.chunk(3), strict=True):
                found[f"{place}.{part}.{last.removeprefix('in_proj_')}"] = piece
        elif place.endswith("_bn"):
            norms.setdefault(place.removesuffix("_bn"), {})[last] = value
        else:
            found[key] = value.reshape(value.shape[-2:]) if key == "style_places" else value
    for place, norm in norms.items():
        scale = norm["weight"] * torch.rsqrt(norm["running_var"] + 1e-5)
        found[f"{place}.scale"] = scale
        found[f"{place}.shift"] = norm["bias"] - norm["running_mean"] * scale
    return found


def batch(height: int, width: int, dim: int) -> dict[str, Tensor]:
    """Noise in the place of data; half of the chunks end after 30 actions."""
    rng = torch.Generator().manual_seed(0)
    length = torch.tensor([CHUNK, 30]).repeat(BATCH // 2)
    return {
        "images": torch.randn(BATCH, 3, height, width, generator=rng),
        "states": torch.randn(BATCH, dim, generator=rng),
        "actions": torch.randn(BATCH, CHUNK, dim, generator=rng),
        "action_masks": (torch.arange(CHUNK) < length[:, None]).float(),
    }


def check(env: Env, root: Path, folder: Path) -> dict[str, Any]:
    """Parameters of both, and how far what they compute is apart."""
    from safetensors.torch import load_file

    from benchmarks._act_model import BenchACT
    from tools import shell

    command = [env.python, __file__, str(root), str(folder)]
    shell.run(command, env=env.variables(), quiet=True, echo=False)
    state, theirs = (load_file(folder / f"{name}.safetensors") for name in ("state", "found"))
    shapes = json.loads((folder / "shapes.json").read_text(encoding="utf-8"))
    model = BenchACT(dropout=0.0, state_dim=shapes["dim"], action_dim=shapes["dim"])
    model.load_state_dict(ours(state))
    data = batch(**shapes)
    with mock.patch("torch.randn_like", torch.zeros_like):
        loss = model(**data)["loss"]
    loss.backward()
    gradients = {name: p.grad for name, p in model.named_parameters() if p.grad is not None}
    with torch.no_grad():
        actions = model.eval().predict_action(**data)
    expected = ours({n.removeprefix("d "): v for n, v in theirs.items() if n.startswith("d ")})
    assert set(expected) == {name for name, _ in model.named_parameters()}
    return {
        "parameters": {
            "lerobot": int(theirs["parameters"]),
            "fluxvla": sum(p.numel() for p in model.parameters()),
        },
        "relative_difference": {
            "loss": apart(loss.detach(), theirs["loss"]),
            "actions": apart(actions, theirs["actions"]),
            "gradients": apart(flat(gradients, expected), flat(expected, expected)),
        },
    }


def flat(tensors: Mapping[str, Tensor], like: Mapping[str, Tensor]) -> Tensor:
    """All in a row; zeros for those that are not there."""
    return torch.cat([tensors.get(n, torch.zeros_like(v)).flatten() for n, v in like.items()])


def apart(a: Tensor, b: Tensor) -> float:
    """The difference's norm over that of ``b``."""
    return float((a - b).norm() / b.norm())


def main(dataset: str, folder: str) -> None:
    """LeRobot's half: the weights that it draws, and what it computes with them."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from safetensors.torch import save_file

    info = json.loads((Path(dataset) / "meta" / "info.json").read_text(encoding="utf-8"))
    height, width, _ = info["features"]["observation.images.top"]["shape"]
    dim = info["features"]["action"]["shape"][0]
    seen = {
        "observation.images.top": PolicyFeature(FeatureType.VISUAL, (3, height, width)),
        "observation.state": PolicyFeature(FeatureType.STATE, (dim,)),
    }
    config = ACTConfig(
        input_features=seen,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (dim,))},
        device="cpu",
        pretrained_backbone_weights=None,
        dropout=0.0,
    )
    torch.manual_seed(0)
    policy = ACTPolicy(config).train()
    data = batch(height, width, dim)
    given = {
        "observation.images.top": data["images"],
        "observation.state": data["states"],
        "action": data["actions"],
        "action_is_pad": data["action_masks"] == 0,
    }
    with mock.patch("torch.randn_like", torch.zeros_like):
        loss, _ = policy(given)
    loss.backward()
    actions = policy.predict_action_chunk(given)
    out = Path(folder)
    save_file(whole(policy.state_dict()), out / "state.safetensors")
    gradients = {
        f"d {n}": torch.zeros_like(p) if p.grad is None else p.grad
        for n, p in policy.named_parameters()
    }
    parameters = torch.tensor(sum(p.numel() for p in policy.parameters()))
    found = {"loss": loss.detach(), "actions": actions, "parameters": parameters, **gradients}
    save_file(whole(found), out / "found.safetensors")
    shapes = {"height": height, "width": width, "dim": dim}
    (out / "shapes.json").write_text(json.dumps(shapes), encoding="utf-8")


def whole(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.contiguous().clone() for name, value in tensors.items()}


if __name__ == "__main__":
    main(*sys.argv[1:])
