"""What ``fluxvla export --format lerobot`` writes of ACT and Diffusion Policy.

``tests/written`` has it without the weights; ``tests/oracles/make_lerobot_written.py`` loads that
in LeRobot and records the commands which follow there.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from fluxvla_models.diffusion_policy import DiffusionPolicy
from fluxvla_models.lerobot_format import LeRobotACT, LeRobotDiffusion
from safetensors.torch import load_file

from fluxvla_core.cli.main import main
from fluxvla_core.contracts.policy import with_history
from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import ForeignCheckpoint, load_policy
from fluxvla_core.training.export import import_checkpoint

from .test_lerobot_parity import (
    ACTING,
    ARM,
    BATCH,
    CASES,
    CONSTANTS,
    GOLDEN,
    close,
    observation,
    published,
    step_noise,
    tensors,
)

WRITTEN = Path(__file__).parent / "written"
CHANGED = {"n_action_steps"}
"""How many actions LeRobot executes, which is the runner's business here."""


@pytest.fixture(scope="module", params=CASES)
def gone_and_back(request, tmp_path_factory) -> tuple[str, Path, Path]:
    """A case, our checkpoint of it, and that written as LeRobot's."""
    case, root = request.param, tmp_path_factory.mktemp(request.param)
    source = published(case, root / "theirs")
    import_checkpoint(source, root / "ours", embodiment=ARM, action_rate_hz=50.0)
    assert main(["export", str(root / "ours"), str(root / "back"), "--format", "lerobot"]) == 0
    return case, root / "ours", root / "back"


def test_every_tensor_comes_back_bit_for_bit(gone_and_back) -> None:
    case, _, back = gone_and_back
    found, expected = load_file(back / "model.safetensors"), tensors(case)
    assert found.keys() == expected.keys()
    constants = load_file(GOLDEN / "written_act_diffusion.safetensors")
    for name, tensor in found.items():
        own = constants[f"{case} {name}"] if name.endswith(CONSTANTS) else expected[name]
        assert torch.equal(tensor, own), name


def test_config_and_processors_mean_what_they_meant(gone_and_back) -> None:
    case, _, back = gone_and_back
    config, theirs = (read(folder / "config.json") for folder in (back, GOLDEN / case))
    assert config.keys() <= theirs.keys()
    assert {n for n in config if config[n] != theirs[n]} <= CHANGED
    for stem in ("policy_preprocessor", "policy_postprocessor"):
        steps, known = (read(f / f"{stem}.json")["steps"] for f in (back, GOLDEN / case))
        assert [step["registry_name"] for step in steps] == [s["registry_name"] for s in known]
        assert [step["config"] for step in steps] == [step["config"] for step in known]
        for own, other in zip(steps, known, strict=True):
            assert ("state_file" in own) == ("state_file" in other)
            if "state_file" not in own:
                continue
            numbers = load_file(back / own["state_file"])
            published_numbers = load_file(GOLDEN / case / other["state_file"])
            assert {"action.mean", "action.min"} & numbers.keys()
            for name, value in numbers.items():
                assert torch.equal(value, published_numbers[name]), name


def test_it_is_what_lerobot_was_given(gone_and_back) -> None:
    """LeRobot's side was computed with these files: if they change, so does that, by nox."""
    case, _, back = gone_and_back
    files = {file.name for file in back.iterdir()} - {"model.safetensors"}
    assert files == {file.name for file in (WRITTEN / case).iterdir()}
    for name in files:
        assert (back / name).read_bytes() == (WRITTEN / case / name).read_bytes(), name


def test_it_acts_here_as_it_does_in_lerobot(gone_and_back, tmp_path, monkeypatch) -> None:
    case, _, back = gone_and_back
    commands = load_file(GOLDEN / "written_act_diffusion.safetensors")[f"{case} commands"]
    if case in ACTING:
        theirs = load_file(GOLDEN / f"{case}.safetensors")["commands"]
        close(commands[: len(theirs)], theirs)
    import_checkpoint(back, tmp_path / "again", embodiment=ARM, action_rate_hz=50.0)
    policy = load_policy(tmp_path / "again")
    model = policy.model
    if isinstance(model, DiffusionPolicy):
        from tests.oracles import fill

        start = fill.normal("noise", (BATCH, *model.action_shape))[:1]
        monkeypatch.setattr(policy, "_noise", lambda seed, call: start)
        monkeypatch.setattr(
            "fluxvla_models.diffusion_policy.following",
            lambda noise, count: step_noise(model, len(noise)),
        )
    chunk = policy.predict_action(with_history(observation(policy.cameras), policy.n_obs_steps))
    close(torch.from_numpy(chunk).float(), commands)


def read(file: Path) -> dict:
    return json.loads(file.read_text())


# -- what LeRobot cannot say -----------------------------------------------------------------------


def act(**more: object) -> ForeignCheckpoint:
    row = {"mean": [0.5] * 6, "std": [2.0] * 6, "min": [-3.0] * 6, "max": [5.0] * 6}
    facts: dict[str, object] = {
        "model": {"type": "ACT", "state_dim": 6, "action_dim": 6, "num_cameras": 2},
        "tensors": {},
        "img_keys": ("front", "wrist"),
        "transforms": (
            {"type": "ResizeImages", "height": 72, "width": 96},
            {"type": "SimpleNormalizeImages"},
            {"type": "NormalizeStatesAndActions", "norm_type": "min_max"},
            {"type": "SampleLatentNoise", "dim": 32},
        ),
        "statistics": {"private": {"proprio": row, "action": row}},
        "horizon": 100,
        "embodiment": ARM,
    }
    return ForeignCheckpoint(**{**facts, **more})


def numbers(**more: object) -> tuple[dict[str, object], ...]:
    return (*act().transforms[:2], {"type": "NormalizeStatesAndActions", **more})


@pytest.mark.parametrize(
    "table",
    [
        {"norm_type": "min_max"},
        {"norm_type": "min_max", "epsilon": 1e-8, "epsilon_if_zero": True},
        {"norm_type": "quantile"},
        {"norm_type": "mean_std", "std_floor": 3.0},
        {"norm_type": "none", "state_norm_type": "mean_std"},
        {"norm_type": "mean_std", "action_norm_mask": [True] * 5 + [False], "epsilon": 1e-3},
    ],
)
def test_every_normalisation_becomes_lerobots(tmp_path: Path, table: dict) -> None:
    """What was trained here acts by the same numbers there."""
    from fluxvla_core.data import Pipeline

    row = {**act().statistics["private"]["action"], "q01": [-2.0] * 6, "q99": [3.0] * 6}
    still = float(np.float32(1.7))
    for name in ("mean", "min", "max", "q01", "q99"):  # one that never moves
        row[name] = [still, *row[name][1:]]
    checkpoint = act(
        transforms=numbers(**table), statistics={"private": {"proprio": row, "action": row}}
    )
    LeRobotACT().write(checkpoint, tmp_path)
    found = LeRobotACT().read(tmp_path)
    values = np.linspace(-4.0, 6.0, 12).reshape(2, 6)
    values[:, 0] = still
    sample = {"states": values[0], "actions": values}
    ours, theirs = (
        Pipeline([read.transforms[-1]])({**sample, "stats": read.statistics["private"]})
        for read in (checkpoint, found)
    )
    for key in ("states", "actions"):
        np.testing.assert_allclose(ours[key], theirs[key], rtol=1e-5, atol=1e-6)
    images = {"images": np.full((6, 72, 96), 200, np.uint8)}
    one, other = (Pipeline([read.transforms[1]])(images) for read in (checkpoint, found))
    np.testing.assert_allclose(one["images"], other["images"], rtol=1e-5)
    assert found.img_keys == ("observation.images.front", "observation.images.wrist")


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"model": {**act().model, "backbone_norm": "group"}}, "backbone_norm is 'group'; LeRobot"),
        ({"model": {**act().model, "backbone_width": 16}}, "backbone_width is 16; LeRobot's ACT"),
        ({"model": {**act().model, "action_dim": 7}}, r"action have shape \(6,\); .* takes 7"),
        (
            {
                "transforms": (
                    *act().transforms,
                    {"type": "CropImages", "top": 0, "left": 0, "height": 9, "width": 9},
                )
            },
            "CropImages is among the transforms",
        ),
        ({"transforms": act().transforms[:2]}, "a normalisation is not among the transforms"),
        (
            {"transforms": ({"type": "ResizeImages", "height": 9, "width": 9}, *numbers()[1:])},
            "cameras and ResizeImages have 9 x 9, 72 x 96",
        ),
        ({"statistics": {"private": {}}}, "has no statistics of 'proprio'"),
        (
            {
                "statistics": {
                    "private": {
                        "proprio": act().statistics["private"]["proprio"],
                        "action": {
                            **act().statistics["private"]["action"],
                            "relative": [1.0] * 6,
                        },
                    }
                }
            },
            "actions are counted from the state",
        ),
    ],
)
def test_what_lerobot_cannot_say_is_refused(tmp_path: Path, more: dict, message: str) -> None:
    with pytest.raises(CheckpointError) as caught:
        LeRobotACT().write(act(**more), tmp_path)
    assert re.search(message, str(caught.value))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"backbone_norm": "frozen_batch"}, "backbone_norm is 'frozen_batch'"),
        (
            {"resize_shape": [80, 90], "crop_shape": [40, 80]},
            r"crop_shape \(40, 80\) is not the same share",
        ),
    ],
)
def test_diffusion_policies_that_lerobot_does_not_have(
    tmp_path: Path, more: dict, message: str
) -> None:
    model = {**act().model, "type": "DiffusionPolicy", "horizon": 8, **more}
    transforms = (*act().transforms[:3], {"type": "SampleDiffusionNoise"})
    with pytest.raises(CheckpointError, match=message):
        LeRobotDiffusion().write(act(model=model, transforms=transforms), tmp_path)
    assert not list(tmp_path.iterdir())
