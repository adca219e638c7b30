"""What LeRobot does with the ACT and Diffusion Policy folders that FluxVLA writes.

    nox -s oracles, or:
    PYTHONPATH=. $(python -m tools.oracle_env) \
        plugins/fluxvla-models/tests/oracles/make_lerobot_written.py

``tests/written/<case>/`` is what ``fluxvla export --format lerobot`` makes of each case of
``make_lerobot.py``, without the weights; test_lerobot_write.py compares. They are filled by their
names here, as there, and the constants that FluxVLA writes beside them are LeRobot's own, which are
recorded. ``written_act_diffusion.safetensors`` has those, and the commands that follow in LeRobot
from raw images and joint states.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from pathlib import Path
from unittest import mock

import lerobot
import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.factory import make_pre_post_processors
from safetensors import safe_open
from safetensors.numpy import save_file
from safetensors.torch import save_file as save_tensors

from tests.oracles import fill

ENVIRONMENT = "lerobot061"
TESTS = Path(__file__).parents[1]
JOINTS = 6
CONSTANTS = ("vae_encoder_pos_enc", "pos_grid")


def filled(name: str, shape: list[int]) -> np.ndarray:
    """As ``make_lerobot.py`` fills it."""
    if name.endswith("num_batches_tracked"):
        return np.zeros((), np.int64)
    if name.endswith("running_var"):
        return fill.uniform(name, shape, 0.5, 1.5)
    scale = len(shape) == 1 and name.endswith(".weight")
    return fill.weight(name, shape) + np.float32(scale)


def results(case: str, folder: Path) -> dict[str, np.ndarray]:
    """Constants and commands of one written folder."""
    config = PreTrainedConfig.from_pretrained(folder)
    kind = ACTPolicy if config.type == "act" else DiffusionPolicy
    fresh = kind(config).state_dict()
    found = {
        f"{case} {name}": tensor.numpy().copy()
        for name, tensor in fresh.items()
        if name.endswith(CONSTANTS)
    }
    with safe_open(TESTS / "golden" / f"{case}.safetensors", "np") as file:
        shapes = json.loads(file.metadata()["names"])
    tensors = {
        name: fresh[name] if name.endswith(CONSTANTS) else torch.from_numpy(filled(name, shape))
        for name, shape in shapes.items()
    }
    save_tensors(tensors, folder / "model.safetensors", {"format": "pt"})
    policy = kind.from_pretrained(folder, strict=True).eval()
    before, after = make_pre_post_processors(config, pretrained_path=str(folder))
    raw = {"observation.state": torch.from_numpy(fill.normal("raw state", (JOINTS,)))}
    for name, feature in config.image_features.items():
        pixels = fill.integers(f"raw {name}", (*feature.shape[1:], 3), 256).astype(np.uint8)
        raw[name] = torch.from_numpy(pixels).permute(2, 0, 1).float() / 255
    ready = before(raw)
    with torch.no_grad():
        if config.type == "act":
            chunk = policy.predict_action_chunk(ready)
        else:
            chunk = denoised(policy, ready)
        found[f"{case} commands"] = after(chunk)[0].numpy()
    return found


def denoised(policy: DiffusionPolicy, ready: dict[str, torch.Tensor]) -> torch.Tensor:
    """A chunk from the noise that ``make_lerobot.py`` has."""
    config = policy.config
    shape = (3, config.horizon, JOINTS)
    steps = fill.normal("step_noise", (3, config.num_inference_steps - 1, *shape[1:]))
    added = iter([torch.from_numpy(steps[:1, i].copy()) for i in range(steps.shape[1])])
    start = torch.from_numpy(fill.normal("noise", shape))[:1]
    # As at an episode's beginning, whose first observation is repeated.
    seen = {
        k: torch.stack([v] * config.n_obs_steps, dim=1) if k in config.input_features else v
        for k, v in ready.items()
    }
    with mock.patch(
        "diffusers.schedulers.scheduling_ddpm.randn_tensor",
        side_effect=lambda *_, **__: next(added),
    ):
        return policy.predict_action_chunk(seen, noise=start)


def main() -> None:
    torch.set_num_threads(1)
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else TESTS / "golden")
    folder.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, np.ndarray] = {}
    for written in sorted((TESTS / "written").iterdir()):
        with tempfile.TemporaryDirectory() as temporary:
            copy = Path(temporary) / written.name
            shutil.copytree(written, copy)
            arrays |= results(written.name, copy)
    versions = {"lerobot": lerobot.__version__, "torch": torch.__version__}
    contiguous = {name: np.ascontiguousarray(value) for name, value in arrays.items()}
    save_file(contiguous, folder / "written_act_diffusion.safetensors", versions)


if __name__ == "__main__":
    main()
