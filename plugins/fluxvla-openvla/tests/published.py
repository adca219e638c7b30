"""Folders as the authors' code saves them, of tiny models."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from fluxvla_openvla.openvla import OpenVLA
from fluxvla_openvla.openvla_oft import OpenVLAOFT
from safetensors.torch import save_file
from tokenizers import Tokenizer
from tokenizers.models import WordLevel
from tokenizers.pre_tokenizers import Whitespace
from tokenizers.processors import TemplateProcessing

from . import tiny

PROMPT = "in : what action should the robot take to pick up the cup ? out put it down"
OFT = {"horizon": 8, "action_dim": 7, "num_images": 2, "state_dim": 8}


def row(dim: int, low: float = -1.0, high: float = 1.0) -> dict[str, list]:
    return {
        **{key: [low] * dim for key in ("q01", "min")},
        **{key: [high] * dim for key in ("q99", "max")},
        "mean": [0.0] * dim,
        "std": [1.0] * dim,
    }


def entry() -> dict[str, dict]:
    action = {**row(7, -0.5, 1.5), "mask": [True] * 6 + [False]}
    return {"action": action, "proprio": row(8, -2.0, 2.0), "num_transitions": 3}


def write_tokenizer(folder: Path) -> None:
    """Words to ids, with ``<s>`` in front; unknown words and signs are one token."""
    vocabulary = {"<unk>": 0, "<s>": 1, "</s>": 2}
    vocabulary |= {word: 3 + i for i, word in enumerate(dict.fromkeys(PROMPT.split()))}
    made = Tokenizer(WordLevel(vocabulary, unk_token="<unk>"))
    made.pre_tokenizer = Whitespace()
    made.post_processor = TemplateProcessing(
        single="<s> $A", pair="<s> $A $B", special_tokens=[("<s>", 1)]
    )
    made.save(str(folder / "tokenizer.json"))


def write_tables(folder: Path, statistics: dict, sidecar: dict | None = None) -> None:
    text = {"model_type": "llama", "vocab_size": 32064, "pad_token_id": 32000, **tiny.LANGUAGE}
    config = {
        "model_type": "openvla",
        "vision_backbone_id": "dinosiglip-vit-so-224px",
        "auto_map": {"AutoConfig": "configuration_prismatic.OpenVLAConfig"},
        "pad_to_multiple_of": 64,
        "text_config": text,
    }
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "dataset_statistics.json").write_text(json.dumps(statistics))
    notes = {"model": tiny.TOWERS, **(sidecar or {})}
    (folder / "fluxvla_openvla.json").write_text(json.dumps(notes))
    write_tokenizer(folder)


def openvla(folder: Path, statistics: dict | None = None, **sidecar) -> OpenVLA:
    """Weights in two files with an index, in bfloat16."""
    folder.mkdir()
    torch.manual_seed(0)
    model = OpenVLA(**tiny.SIZES)
    write_base(folder, model.state_dict())
    write_tables(folder, statistics or {"bridge_orig": entry()}, sidecar)
    return model


def write_base(folder: Path, state: dict[str, torch.Tensor]) -> None:
    names = sorted(state)
    files = ("model-00001-of-00002.safetensors", "model-00002-of-00002.safetensors")
    index = {}
    for file, part in zip(files, (names[::2], names[1::2]), strict=True):
        save_file({n: state[n].bfloat16().contiguous() for n in part}, folder / file)
        index |= dict.fromkeys(part, file)
    content = {"metadata": {}, "weight_map": index}
    (folder / "model.safetensors.index.json").write_text(json.dumps(content))


def oft(folder: Path, dataset: str = "libero_spatial_no_noops", **settings) -> OpenVLAOFT:
    """OpenVLA-OFT: its own files hold ``module.``, as DDP saves them."""
    folder.mkdir()
    torch.manual_seed(0)
    model = OpenVLAOFT(**{**tiny.SIZES, **OFT, **settings})
    state = model.state_dict()
    parts: dict[str, dict[str, torch.Tensor]] = {}
    base, film = {}, {}
    for name, tensor in state.items():
        part, _, rest = name.partition(".")
        own = part in ("action_head", "proprio_projector", "noisy_action_projector")
        if own:
            parts.setdefault(part, {})[f"module.{rest}"] = tensor.bfloat16()
        elif model.use_film and part == "vision_backbone":
            film[tiny.film_file_name(name)] = tensor.bfloat16()
        else:
            base[name] = tensor
    if model.use_film:
        parts["vision_backbone"] = unmerged(film)
        # The published folder has OpenVLA's own there, which are not used.
        plain = [n for n in state if n.startswith("vision_backbone.") and not _film(n)]
        base |= {name: torch.zeros_like(state[name]) for name in plain}
    write_base(folder, base)
    for part, tensors in parts.items():
        torch.save(tensors, folder / f"{part}--150000_checkpoint.pt")
    write_tables(folder, {dataset: entry()})
    return model


def unmerged(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """``tensors`` under the names that the authors' code saves, with LoRA that adds nothing."""
    names = json.loads((tiny.HERE / "keys" / "openvla-oft-film-tiny.json").read_text())
    made = {"lora_A": torch.ones, "lora_B": torch.zeros}
    found = {}
    for name, shape in names.items():
        kind = name.split(".")[-3]
        if kind in made:
            found[name] = made[kind](shape)
        else:
            found[name] = tensors[name.replace(".base_layer.", ".")]
    return found


def native(folder: Path) -> OpenVLA:
    """The native layout of a training with Prismatic's code."""
    (folder / "checkpoints").mkdir(parents=True)
    torch.manual_seed(0)
    model = OpenVLA(**tiny.SIZES)
    parts: dict[str, dict[str, torch.Tensor]] = {
        "vision_backbone": {},
        "projector": {},
        "llm_backbone": {},
    }
    places = {"fc1": "0", "fc2": "2", "fc3": "4"}
    for name, tensor in model.state_dict().items():
        part, _, rest = name.partition(".")
        if part == "vision_backbone":
            tower, _, rest = rest.partition(".")
            tower = "dino_featurizer" if tower == "featurizer" else "siglip_featurizer"
            parts[part][f"{tower}.{rest.replace('scale_factor', 'gamma')}"] = tensor
        elif part == "projector":
            layer, _, kind = rest.partition(".")
            parts[part][f"projector.{places[layer]}.{kind}"] = tensor
        else:
            parts["llm_backbone"][f"llm.{rest}"] = tensor
    torch.save({"model": parts}, folder / "checkpoints" / "latest-checkpoint.pt")
    write_tables(folder, {"bridge_orig": entry()}, {"model": tiny.SIZES})
    (folder / "config.json").write_text(json.dumps({"vla": {"base_vlm": "prism-dinosiglip"}}))
    return model


def _film(name: str) -> bool:
    return name.rsplit(".", 2)[-2] in ("scale", "shift")
