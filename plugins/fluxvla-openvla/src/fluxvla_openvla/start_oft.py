"""``fluxvla openvla-oft SRC OUT``: what a training of OpenVLA-OFT starts from."""

from __future__ import annotations

import argparse
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluxvla_core import build_vla_from_cfg
from fluxvla_core.errors import UsageError
from fluxvla_openvla.folder import PLATFORMS, Platform
from fluxvla_openvla.sizes import HEADS

if TYPE_CHECKING:  # fluxvla openvla-oft --help needs no torch
    import torch
    from torch import Tensor, nn

    from fluxvla_core.models import ForeignCheckpoint

_FILES = ("tokenizer.json", "tokenizer_config.json", "special_tokens_map.json")
_FRESH = ("action_head", "proprio_projector", "noisy_action_projector")


class StartOFT:
    """Give OpenVLA's weights new heads, so that a training of OpenVLA-OFT has a base."""

    api = "1.0"
    help = (
        "Make the folder that a training of OpenVLA-OFT starts from (runner.init_from): OpenVLA's "
        "weights and new, random ones of what OpenVLA does not have (action head, state "
        "projector, FiLM)."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """The command line."""
        parser.add_argument("source", metavar="SRC", help="a folder of OpenVLA, as published")
        parser.add_argument("folder", metavar="OUT", help="the folder to make")
        parser.add_argument("--robot", choices=sorted(PLATFORMS), default="libero")
        parser.add_argument("--action-dim", type=int, default=7)
        parser.add_argument("--state-dim", type=int, default=8, help="0: without the state")
        parser.add_argument("--horizon", type=int, help="default: the paper's for the robot")
        parser.add_argument("--cameras", type=int, help="default: the paper's for the robot")
        parser.add_argument("--head", choices=HEADS, default="l1")
        parser.add_argument("--film", action="store_true", help="OpenVLA-OFT+, for ALOHA")
        parser.add_argument("--seed", type=int, default=7, help="of the new weights")

    def run(self, args: argparse.Namespace) -> int:
        """Make the folder."""
        from fluxvla_openvla.formats import OpenVLAFormat

        origin, target = Path(args.source), Path(args.folder)
        if target.exists():
            raise UsageError(f"there is something at {target} already")
        if not OpenVLAFormat().recognizes(origin):
            raise UsageError(
                f"{origin} is no folder of OpenVLA: its config.json does not say so",
                next="name a copy of openvla/openvla-7b",
            )
        platform = PLATFORMS[args.robot]
        cameras = platform.cameras[: args.cameras] if args.cameras else platform.cameras
        names = (*cameras, *(f"image_{i}" for i in range(len(cameras), args.cameras or 0)))
        changes = {
            "horizon": args.horizon or platform.horizon,
            "action_dim": args.action_dim,
            "num_images": len(names),
            "state_dim": args.state_dim,
            "head": args.head,
            "use_film": args.film,
        }
        source = OpenVLAFormat().read(origin)
        started, fresh = with_new_parts(source, changes, platform, names, args.seed)
        _write(started, origin, target)
        count = sum(tensor.numel() for tensor in fresh.values())
        print(f"{target}: {len(started.tensors)} tensors; {len(fresh)} are new ({count:,} numbers)")
        return 0


def _write(started: ForeignCheckpoint, origin: Path, target: Path) -> None:
    """Write aside and rename, so that there is all of ``target`` or nothing."""
    from fluxvla_openvla.formats import OpenVLAFormat

    aside = target.with_name(f"{target.name}.partial")
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir(parents=True)
    try:
        OpenVLAFormat().write(started, aside)
        for file in (origin / name for name in _FILES):
            if file.is_file():
                shutil.copyfile(file, aside / file.name)
        os.replace(aside, target)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def with_new_parts(
    source: ForeignCheckpoint,
    changes: Mapping[str, Any],
    platform: Platform,
    cameras: tuple[str, ...],
    seed: int,
) -> tuple[ForeignCheckpoint, dict[str, Tensor]]:
    """OpenVLA as the base of an OpenVLA-OFT, and which tensors of it are new.

    The new ones are drawn as the model's constructor draws them, in bfloat16 like the others.

    Args:
        changes: the model's parameters that OpenVLA does not have.
        platform: how its images, states and actions are prepared.
        cameras: names of the images.
        seed: of the new weights.

    Raises:
        UsageError: ``source`` is not OpenVLA.
    """
    import torch
    from torch import nn

    from fluxvla_core.models import ForeignCheckpoint
    from fluxvla_openvla.formats import transforms

    if source.model["type"] != "OpenVLA":
        raise UsageError(f"the source is {source.model['type']} already; train on from it directly")
    kept = {key: source.model[key] for key in _SIZES if key in source.model}
    model = {**kept, **changes, "type": "OpenVLAOFT"}
    with torch.device("meta"):
        built: nn.Module = build_vla_from_cfg(model)
    fresh: dict[str, Tensor] = {}
    generator = torch.Generator().manual_seed(seed)
    for name, module in built.named_modules():
        if _is_fresh(name) and isinstance(module, nn.Linear | nn.LayerNorm):
            fresh |= {f"{name}.{key}": t for key, t in _drawn(module, generator).items()}
    started = ForeignCheckpoint(
        model=model,
        tensors={**source.tensors, **fresh},
        img_keys=cameras,
        transforms=transforms(
            source.transforms[-1]["tokenizer"]["model_path"],
            bounds=platform.bounds,
            states=changes["state_dim"] > 0,
            gripper=platform.gripper,
            crop=True,
            resize="lanczos",
            size=model.get("image_size", 224),
        ),
        statistics=source.statistics,
        horizon=changes["horizon"],
        action_rate_hz=platform.rate_hz,
    )
    return started, fresh


_SIZES = ("image_size", "dino", "siglip", "language")


def _is_fresh(name: str) -> bool:
    parts = name.split(".")
    film = parts[0] == "vision_backbone" and parts[-1] in ("scale", "shift")
    return parts[0] in _FRESH or film


def _drawn(module: nn.Linear | nn.LayerNorm, generator: torch.Generator) -> dict[str, Tensor]:
    """torch's own first weights: uniform up to 1/sqrt(inputs) for layers, 1 and 0 for norms."""
    import torch
    from torch import nn

    shapes = {name: parameter.shape for name, parameter in module.named_parameters()}
    if isinstance(module, nn.LayerNorm):
        made = {"weight": torch.ones(shapes["weight"]), "bias": torch.zeros(shapes["bias"])}
    else:
        limit = module.in_features**-0.5
        made = {
            name: (torch.rand(shape, generator=generator) * 2 - 1) * limit
            for name, shape in shapes.items()
        }
    return {name: tensor.to(torch.bfloat16) for name, tensor in made.items()}
