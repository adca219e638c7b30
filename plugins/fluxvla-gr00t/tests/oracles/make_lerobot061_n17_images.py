"""What LeRobot 0.6.1 makes of images for GR00T N1.7, up to the patches of the Qwen processor.

Run from the repository's root in an environment with LeRobot 0.6.1 and transformers 5.5.4:

    PYTHONPATH=. python plugins/fluxvla-gr00t/tests/oracles/make_lerobot061_n17_images.py

It writes tests/golden/lerobot061_n17_images.safetensors.
"""

from __future__ import annotations

import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from lerobot.policies.groot.processor_groot import (
    _transform_n1_7_image_for_vlm_albumentations,
    _transform_n1_7_image_for_vlm_torch,
)
from safetensors.torch import save_file
from transformers import Qwen2VLImageProcessor

from tests.oracles import fill

ENVIRONMENT = "lerobot061"
SIZES = {"wide": (60, 80), "tall": (90, 50)}


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    # Least sizes as in Qwen3-VL's processor, in proportion to its images.
    processor = Qwen2VLImageProcessor(
        patch_size=16,
        merge_size=2,
        temporal_patch_size=2,
        image_mean=[0.5, 0.5, 0.5],
        image_std=[0.5, 0.5, 0.5],
        size={"shortest_edge": 64 * 64, "longest_edge": 4096 * 64},
    )
    found = {}
    for name, size in SIZES.items():
        picture = fill.integers(f"picture {name}", (*size, 3), 256).astype(np.uint8)
        settings = {
            "image_crop_size": [58, 58],
            "image_target_size": [64, 64],
            "shortest_image_edge": None,
            "crop_fraction": None,
        }
        planes = torch.from_numpy(picture).permute(2, 0, 1).contiguous()
        for letter_box in (False, True):
            kind = f"{name}.{'square' if letter_box else 'plain'}"
            bicubic = _transform_n1_7_image_for_vlm_torch(
                planes, **settings, letter_box_transform=letter_box
            )
            area = _transform_n1_7_image_for_vlm_albumentations(
                picture, **settings, letter_box_transform=letter_box
            )
            found[f"{kind}.bicubic"] = bicubic
            found[f"{kind}.area"] = torch.from_numpy(area).permute(2, 0, 1)
            if letter_box:
                continue
            for method in ("bicubic", "area"):
                made = processor(found[f"{kind}.{method}"], return_tensors="pt")
                found[f"{kind}.{method}.grid"] = made["image_grid_thw"]
                # One row in sixteen, to keep the file small.
                found[f"{kind}.{method}.patches"] = made["pixel_values"][::16]
    about = {name: version(name) for name in ("lerobot", "transformers", "torch", "torchvision")}
    folder.mkdir(parents=True, exist_ok=True)
    made = {name: value.contiguous() for name, value in found.items()}
    save_file(made, folder / "lerobot061_n17_images.safetensors", about)


if __name__ == "__main__":
    here = Path(__file__).resolve().parents[1] / "golden"
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else here)
