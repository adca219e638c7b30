"""ACT and Diffusion Policy compute what LeRobot's do, number by number.

``tests/oracles/make_lerobot.py`` wrote what is compared with.
"""

from __future__ import annotations

import json
import shutil
from contextlib import ExitStack
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch
from fluxvla_models.act import ACT
from fluxvla_models.diffusion_policy import DiffusionPolicy
from fluxvla_models.diffusion_schedule import BETAS, KINDS, PREDICTIONS, DiffusionSchedule
from fluxvla_models.lerobot_format import LeRobotACT, LeRobotDiffusion
from fluxvla_models.lerobot_names import act_name, diffusion_name
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from fluxvla_core import EmbodimentSpec
from fluxvla_core.checkpoints.checkpoint import Checkpoint
from fluxvla_core.contracts.environment import Environment, EnvironmentSpec, Step, TaskSpec
from fluxvla_core.errors import ConfigError
from fluxvla_core.evaluation.policy_server import PolicyServer, ServedPolicy
from fluxvla_core.evaluation.rollout import RolloutSettings, run_episode
from fluxvla_core.models import load_policy
from fluxvla_core.policies.loading import why_not_continued
from fluxvla_core.spec import Camera, Joint
from fluxvla_core.training.export import import_checkpoint
from tests.oracles import fill
from tests.policies.benched import DIVIDED, WHOLE, stages_of

GOLDEN = Path(__file__).parent / "golden"
KEYS = Path(__file__).parent / "keys"
BATCH, JOINTS = 3, 6
CASES = sorted(p.stem for p in GOLDEN.glob("lerobot_*.safetensors"))
ACTING = [case for case in CASES if not case.endswith("history")]
CONSTANTS = ("vae_encoder_pos_enc", "pos_grid")
ARM = EmbodimentSpec(
    "arm",
    tuple(Joint(f"j{i}", "rad", -20.0, 20.0, 1.0, 1.0) for i in range(JOINTS)),
    (Camera("front", 72, 96), Camera("wrist", 72, 96)),
    50.0,
)


def filled(name: str, shape: list[int]) -> torch.Tensor:
    """As the program fills LeRobot's policy."""
    if name.endswith("running_var"):
        return torch.from_numpy(fill.uniform(name, shape, 0.5, 1.5))
    if name.endswith("num_batches_tracked"):
        return torch.zeros((), dtype=torch.int64)
    scale = len(shape) == 1 and name.endswith(".weight")
    return torch.from_numpy(fill.weight(name, shape)) + float(scale)


def shapes(case: str) -> dict[str, list[int]]:
    """Names and shapes of LeRobot's tensors."""
    with safe_open(GOLDEN / f"{case}.safetensors", "np") as file:
        return json.loads(file.metadata()["names"])


@lru_cache
def tensors(case: str) -> dict[str, torch.Tensor]:
    """LeRobot's tensors, by its names."""
    return {
        name: torch.zeros(shape) if name.endswith(CONSTANTS) else filled(name, shape)
        for name, shape in shapes(case).items()
    }


def our_name(case: str, name: str) -> str | None:
    return (act_name if case.startswith("lerobot_act") else diffusion_name)(name)


@lru_cache
def model_of(case: str) -> ACT | DiffusionPolicy:
    config = json.loads((GOLDEN / case / "config.json").read_text())
    act = case.startswith("lerobot_act")
    table = (LeRobotACT() if act else LeRobotDiffusion()).model(config, case)
    assert table.pop("type") == ("ACT" if act else "DiffusionPolicy")
    model = (ACT if act else DiffusionPolicy)(**table)
    named = {our_name(case, name): tensor for name, tensor in tensors(case).items()}
    named.pop(None, None)
    model.load_state_dict(named)
    return model


def batch_of(case: str, model: ACT | DiffusionPolicy) -> dict[str, torch.Tensor]:
    history = ()
    if isinstance(model, DiffusionPolicy) and model.n_obs_steps > 1:
        history = (model.n_obs_steps,)
    chunk = (BATCH, *model.action_shape)
    masks = torch.ones(chunk[:2])
    masks[1, model.horizon - 3 :] = 0
    cameras = ("front", "wrist")[: model.num_cameras]
    views = [fill.normal(f"observation.images.{c}", (BATCH, *history, 3, 72, 96)) for c in cameras]
    batch = {
        "images": torch.from_numpy(np.concatenate(views, axis=-3)),
        "states": torch.from_numpy(fill.normal("states", (BATCH, *history, JOINTS))),
        "actions": torch.from_numpy(fill.normal("actions", chunk)),
        "action_masks": masks,
    }
    if isinstance(model, ACT):
        size = (BATCH, model.latent_dim)
        return {**batch, "latent_noise": torch.from_numpy(fill.normal("latent_noise", size))}
    return {
        **batch,
        "noise": torch.from_numpy(fill.normal("noise", chunk))[:, None],
        "timesteps": torch.from_numpy(fill.integers("timesteps", (BATCH,), 100))[:, None],
    }


def step_noise(model: DiffusionPolicy, rows: int) -> torch.Tensor:
    shape = (BATCH, model.schedule.count - 1, *model.action_shape)
    return torch.from_numpy(fill.normal("step_noise", shape))[:rows]


def close(found: torch.Tensor, expected: torch.Tensor) -> None:
    scale = expected.abs().max().item()
    torch.testing.assert_close(found, expected, rtol=0.0, atol=1e-5 * scale)


@pytest.mark.parametrize("case", CASES)
def test_loss_and_gradients(case: str) -> None:
    golden = load_file(GOLDEN / f"{case}.safetensors")
    model = model_of(case).train()
    found = model(**batch_of(case, model))
    close(found["loss"].detach().reshape(1), golden["loss"])
    close(found["sample_losses"].mean().reshape(1), golden["loss"])
    found["loss"].backward()
    gradients = dict(model.named_parameters())
    named = [key for key in golden if key.startswith("gradient ")]
    assert len(named) >= 3
    for key in named:
        own = gradients[our_name(case, key.removeprefix("gradient "))].grad.flatten()
        close(own[:: -(-len(own) // 4096)], golden[key])


@pytest.mark.parametrize("case", CASES)
def test_actions(case: str) -> None:
    golden = load_file(GOLDEN / f"{case}.safetensors")
    model = model_of(case).eval()
    batch = batch_of(case, model)
    asked = {"images": batch["images"], "states": batch["states"]}
    start = 0
    if isinstance(model, DiffusionPolicy):
        asked["noise"] = batch["noise"][:, 0]
        asked["step_noise"] = step_noise(model, BATCH)
        start = model.n_obs_steps - 1
    with torch.inference_mode():
        found = model.predict_action(**asked)
    assert found.shape == (BATCH, *model.action_shape)
    close(found[:, start : start + golden["actions"].shape[1]], golden["actions"])


def published(case: str, folder: Path) -> Path:
    """The folder as LeRobot saves it, with the weights, which are too many to be stored."""
    shutil.copytree(GOLDEN / case, folder)
    save_file(tensors(case), folder / "model.safetensors")
    return folder


def observation(cameras: tuple[str, ...], at: str = "raw") -> dict[str, object]:
    return {
        "qpos": fill.normal(f"{at} state", (JOINTS,)),
        "images": {
            name: fill.integers(f"{at} observation.images.{name}", (72, 96, 3), 256).astype(
                np.uint8
            )
            for name in cameras
        },
        "task_description": "lift",
    }


@pytest.mark.parametrize("case", ACTING)
def test_raw_images_and_joints_to_commands(case: str, tmp_path: Path, monkeypatch) -> None:
    golden = load_file(GOLDEN / f"{case}.safetensors")
    source = published(case, tmp_path / "theirs")
    import_checkpoint(
        source, tmp_path / "ours", format="lerobot", embodiment=ARM, action_rate_hz=50.0
    )
    policy = load_policy(tmp_path / "ours")
    model = policy.model
    if isinstance(model, DiffusionPolicy):
        start = fill.normal("noise", (BATCH, *model.action_shape))[:1]
        monkeypatch.setattr(policy, "_noise", lambda seed, call: start)
        monkeypatch.setattr(
            "fluxvla_models.diffusion_policy.following",
            lambda noise, count: step_noise(model, len(noise)),
        )
    chunk = policy.predict_action(observation(policy.cameras))
    close(torch.from_numpy(chunk).float()[: len(golden["commands"])], golden["commands"])
    divided = isinstance(model, DiffusionPolicy)
    stages = stages_of(tmp_path / "ours", tmp_path / "measured")
    assert stages == (DIVIDED if divided else WHOLE)


class Filmed(Environment):
    """Shows the same film whatever is done, and keeps the actions."""

    spec = EnvironmentSpec("film", ARM, (TaskSpec("watch", "lift", max_steps=10),))
    state = np.zeros(JOINTS)

    def reset(self, seed: int, task: str) -> None:
        self.actions: list[np.ndarray] = []
        self.shown: list[int] = []

    def observe(self, cameras):
        step = len(self.actions)
        self.shown.append(step)
        return observation(tuple(camera.name for camera in cameras), f"raw {step}")

    def step(self, action: np.ndarray) -> Step:
        self.actions.append(action)
        return Step(0.0, False, False)

    def close(self) -> None:
        pass


@pytest.mark.parametrize("execution", ["here", "served"])
def test_an_episode_with_earlier_observations(execution: str, tmp_path: Path, monkeypatch) -> None:
    """LeRobot is shown every step and keeps a queue; here the runner keeps what it needs."""
    case = "lerobot_diffusion_history"
    golden = load_file(GOLDEN / f"{case}.safetensors")
    source = published(case, tmp_path / "theirs")
    found, imported = import_checkpoint(
        source, tmp_path / "ours", format="lerobot", embodiment=ARM, action_rate_hz=50.0
    )
    assert imported.notes == ("LeRobot executes 5 of 7 actions: execute_horizon=5",)
    policy = load_policy(found)
    assert (policy.n_obs_steps, policy.horizon) == (2, 7)
    start = fill.normal("noise", (BATCH, *policy.model.action_shape))[:1]
    monkeypatch.setattr(policy, "_noise", lambda seed, call: start)
    monkeypatch.setattr(
        "fluxvla_models.diffusion_policy.following",
        lambda noise, count: step_noise(policy.model, len(noise)),
    )
    film = Filmed()
    settings = RolloutSettings(ARM.cameras[:1], replan_every=5)
    with ExitStack() as stack:
        actor = policy
        if execution == "served":
            server = stack.enter_context(PolicyServer({"p": lambda: policy}))
            actor = ServedPolicy(server.link(), "p", server.facts["p"])
        run_episode(film, actor, film.spec.tasks[0], 3, settings)
    assert film.shown == [0, 4, 5, 9]
    close(torch.from_numpy(np.stack(film.actions)).float(), golden["commands"])


def test_a_question_without_its_history_is_refused(tmp_path: Path) -> None:
    source = published("lerobot_diffusion_history", tmp_path / "theirs")
    found, _ = import_checkpoint(
        source, tmp_path / "ours", format="lerobot", embodiment=ARM, action_rate_hz=50.0
    )
    policy = load_policy(found)
    with pytest.raises(ConfigError, match=r"acts on 2 observations \(n_obs_steps\).*with 1"):
        policy.predict_action(observation(policy.cameras))
    why = why_not_continued(found)
    assert why is not None
    assert why.startswith("DiffusionPolicy cannot continue a chunk: its predict_action() takes no")
    trained_on = Checkpoint.open(found).config()["train_dataloader"]["dataset"]
    assert (trained_on["n_obs_steps"], trained_on["past_actions"]) == (2, 1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("betas", BETAS)
@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize("clip", [True, False])
def test_schedules(kind: str, betas: str, prediction: str, clip: bool) -> None:
    golden = load_file(GOLDEN / "diffusers_schedulers.safetensors")
    key = f"{kind} {betas} {prediction} {clip}"
    schedule = DiffusionSchedule(
        kind, 100, 7, betas, prediction=prediction, clip=1.0 if clip else None
    )
    x, output, added = (
        torch.from_numpy(fill.normal(n, (2, 4, 3))) for n in ("x", "output", "added")
    )
    assert schedule.timesteps == golden[f"{key} timesteps"].tolist()
    rows = schedule.coefficients()
    drawn = [added if kind == "DDPM" and step else None for step in schedule.timesteps]
    steps = [schedule.step(output, x, *each) for each in zip(rows, drawn, strict=True)]
    close(torch.stack(steps), golden[f"{key} steps"])
    close(schedule.add_noise(x, added, torch.tensor([3, 97])), golden[f"{key} noisy"])
