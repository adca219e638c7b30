"""``LeRobotPolicy``: whatever policy an installed LeRobot can load, for robots and evaluations."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core import Actor, Camera, EmbodimentSpec, Environment, Observation
from fluxvla_core.errors import ConfigError, LoadFailed, SpecMismatch
from fluxvla_core.operators import RunContext
from fluxvla_lerobot.files import STATE, describe
from fluxvla_lerobot.installed import installed_version, known_version, lerobot
from fluxvla_lerobot.loading import Loaded, load
from fluxvla_lerobot.mapping import (
    Columns,
    camera_images,
    cameras_for,
    check_sizes,
    columns_for,
    plain_columns,
)

Array = npt.NDArray[np.float64]
STEP_BY_STEP = frozenset({"tdmpc", "vqbet"})
"""Types of LeRobot that are asked at each step, as they keep queues of their own."""
QUEUED_CHUNKS = frozenset({"diffusion", "multi_task_dit"})
"""Types whose ``select_action`` makes a chunk, puts it into a queue, and takes one from that; their
``predict_action_chunk`` wants what only ``select_action`` prepares."""


class LeRobotPolicy(Actor):
    """A policy that LeRobot saved, acting through LeRobot's own code and processors.

    Args:
        path: folder that LeRobot saved it in, or ``hf:OWNER/NAME[@REVISION]`` on the Hugging Face
            hub.
        embodiment: the robot that it was trained for: an ``embodiment.json``, a dataset's or
            checkpoint's folder with one, or a table. A robot needs it; an evaluation takes the
            environment's by default.
        rate_hz: actions a second, which LeRobot's files do not say. A robot needs it; an
            evaluation takes the environment's by default.
        cameras: the policy's camera -> the robot's, where the names differ.
        left_out: cameras of the policy that the robot lacks, for policies that can do without.
        state, actions: names of the robot's joints in the order of the policy's columns; the
            robot's own order by default.
        degrees: the policy has degrees where the robot has radians, as LeRobot's own arms have.
        each_step: ask the policy at every step through ``select_action``, as LeRobot does, and
            let it keep its own queues; chunks have one action then. By default for policies that
            look at several observations, that average chunks, or that keep queues (TD-MPC, VQ-BeT).
        device: the torch device.
        tokenizer: folder of a tokenizer, instead of the one of the hub that the checkpoint names.
        trust_remote_code: admit policies whose LeRobot code runs Python that comes with files of
            the hub.
        context: what the run knows (injected).

    Raises:
        LoadFailed: LeRobot is not installed, of a version that is not known, or lacks the policy.
        CheckpointError: there is no such policy, it is damaged, or lacks statistics.
        ConfigError: a camera is unknown; or names of joints are given and no embodiment.
        SpecMismatch: the embodiment has other joints, or cameras of another size.
    """

    api = "1.0"
    cameras: tuple[str, ...]
    horizon: int
    stages: dict[str, float]

    def __init__(
        self,
        path: str,
        embodiment: str | Mapping[str, Any] | None = None,
        rate_hz: float | None = None,
        cameras: Mapping[str, str] | None = None,
        left_out: Sequence[str] = (),
        state: Sequence[str] | None = None,
        actions: Sequence[str] | None = None,
        degrees: bool = False,
        each_step: bool | None = None,
        device: str = "cpu",
        tokenizer: str | None = None,
        trust_remote_code: bool = False,
        context: RunContext | None = None,
    ) -> None:
        if rate_hz is not None and not 0.0 < rate_hz < float("inf"):
            raise ConfigError(f"LeRobotPolicy: rate_hz must be positive, got {rate_hz}")
        known_version(installed_version())  # before a checkpoint is fetched
        from fluxvla_core.models import (
            foreign_folder,
        )  # with torch, which a check must not wait for

        folder = foreign_folder(path)
        self._described = described = describe(folder, trust_remote_code)
        self._features = cameras_for(described, cameras or {}, left_out)
        self._left_out = tuple(left_out)
        self._names = (state, actions, degrees)
        self._columns: Columns | None = None if any(self._names) else plain_columns(described)
        self.embodiment = None if embodiment is None else _robot(embodiment)
        if self.embodiment is not None:
            self._columns = columns_for(self.embodiment, described, *self._names)
            sizes = {name: (c.height, c.width) for name, c in self._trained.items()}
            check_sizes(described, self._features, sizes)
        self.cameras = tuple(self._features.values())
        self.action_rate_hz = rate_hz
        self.source = path
        self.stages = {}
        self.device = device
        self._seed = self._calls = 0
        found = lerobot()
        self._raw = found.raw_batch
        self._loaded: Loaded = load(found, folder, described, device, tokenizer)
        self._each_step = self._asked_each_step(each_step)
        self.horizon = self._try_once()
        used = vars(self._loaded.policy.config).get("n_action_steps")
        if context is not None and isinstance(used, int) and used < self.horizon:
            context.reporter.info(
                f"LeRobot executes {used} of {self.horizon} actions: execute_horizon = {used} does "
                "so here (replan_every in an evaluation)"
            )

    def enter(self, environment: Environment) -> None:
        """Take the environment's joints, unless the policy has an embodiment."""
        if self.embodiment is None:
            robot = environment.spec.embodiment
            self._columns = columns_for(robot, self._described, *self._names)

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self._seed, self._calls = seed, 0
        self._loaded.reset()

    def predict_action(self, observation: Observation) -> Array:
        """``(horizon, D)`` float64 in the embodiment's units.

        Raises:
            DataError: the observation lacks a camera, or its state has another width.
            SpecMismatch: the config names joints, and no robot is known that has them.
        """
        if self._columns is None:
            raise SpecMismatch(
                "state, actions and degrees are about a robot's joints, and none is known",
                next="embodiment = FILE, or an evaluation, whose environment has one",
            )
        began = time.perf_counter()
        seen: dict[str, Any] = dict(camera_images(observation, self._features, self._trained))
        if self.embodiment is None:
            sizes = {self._features[feature]: image.shape[:2] for feature, image in seen.items()}
            check_sizes(self._described, self._features, sizes)
        if self._described.state_dim is not None:
            seen[STATE] = self._columns.states(observation["qpos"])
        mapped = time.perf_counter() - began
        chunk = self._columns.actions(self._answer(seen, observation["task_description"]))
        self.stages["preprocess"] += mapped
        return chunk

    def _asked_each_step(self, given: bool | None) -> bool:
        config = self._loaded.policy.config
        if given is False and config.n_obs_steps > 1:
            raise ConfigError(
                f"LeRobotPolicy: each_step is False, and the policy looks at {config.n_obs_steps} "
                "observations (n_obs_steps), one control step apart",
                cause="between two chunks nothing is observed",
                next="leave each_step out",
            )
        if given is not None:
            return given
        averages = vars(config).get("temporal_ensemble_coeff") is not None
        return self._described.kind in STEP_BY_STEP or config.n_obs_steps > 1 or averages

    @property
    def _trained(self) -> dict[str, Camera]:
        return {} if self.embodiment is None else {c.name: c for c in self.embodiment.cameras}

    def _answer(self, seen: Mapping[str, Any], task: str) -> Array:
        """``(T, D)`` in the units and the order of the policy's data.

        Args:
            seen: LeRobot's features: ``(H, W, 3)`` uint8 images, ``(S,)`` float32 states.
        """
        import torch

        device = torch.device(self.device)
        began = time.perf_counter()
        with self._drawing():
            # Copied: torch makes tensors of the arrays, which belong to the caller.
            raw = self._raw({name: np.array(values) for name, values in seen.items()}, device, task)
            batch = self._loaded.before(raw)
            prepared = time.perf_counter()
            actions = self._actions(batch, device)
            inferred = time.perf_counter()
            chunk = self._loaded.after(actions)
            if chunk.shape[:2] != actions.shape[:2]:
                # A step that takes the last action of a chunk: it is for one action at a time.
                rows = [self._loaded.after(actions[:, i]) for i in range(actions.shape[1])]
                chunk = torch.stack(rows, dim=1)
            numbers: Array = chunk[0].to(device="cpu", dtype=torch.float64).numpy().copy()
        self._calls += 1
        self.stages = {
            "preprocess": prepared - began,
            "inference": inferred - prepared,
            "postprocess": time.perf_counter() - inferred,
        }
        return numbers

    def _actions(self, batch: dict[str, Any], device: Any) -> Any:
        """The policy's actions, a tensor ``(1, T, D)`` that is still normalised."""
        import torch

        policy = self._loaded.policy
        mixed = torch.autocast(device.type) if policy.config.use_amp else contextlib.nullcontext()
        with torch.inference_mode(), mixed:
            if self._each_step:
                return policy.select_action(batch)[:, None]
            if self._described.kind in QUEUED_CHUNKS:
                steps = policy.config.n_action_steps
                return torch.stack([policy.select_action(batch) for _ in range(steps)], dim=1)
            return policy.predict_action_chunk(batch)

    def _try_once(self) -> int:
        """Ask once, with nothing to see: the length of a chunk, which no file of LeRobot says.

        Raises:
            LoadFailed: the policy does not answer, or with something else than actions.
        """
        described, trained = self._described, self._trained
        seen: dict[str, Any] = {}
        for feature, name in self._features.items():
            camera = trained.get(name)
            size = described.sizes[feature] if camera is None else (camera.height, camera.width)
            seen[feature] = np.zeros((*size, 3), np.uint8)
        if described.state_dim is not None:
            seen[STATE] = np.zeros(described.state_dim, np.float32)
        how = "select_action" if self._each_step else "predict_action_chunk"
        other = None if self._each_step else "each_step = True, if it answers from queues"
        self.reset(0)
        try:
            chunk = self._answer(seen, "do the task")
        except Exception as error:
            raise LoadFailed(
                f"a policy of type {described.kind!r} does not answer by {how}: "
                f"{type(error).__name__}: {error}",
                where=self.source,
                cause="it needs the cameras that are left_out" if self._left_out else None,
                next=other,
            ) from error
        if chunk.ndim != 2 or chunk.shape[1] != described.action_dim or not len(chunk):
            raise LoadFailed(
                f"a policy of type {described.kind!r} gives actions of shape {chunk.shape}; "
                f"(T, {described.action_dim}) is expected",
                where=self.source,
                next=other,
            )
        self.reset(0)
        return len(chunk)

    @contextlib.contextmanager
    def _drawing(self) -> Iterator[None]:
        """Whatever LeRobot draws follows from the episode's seed and the number of the call."""
        import torch

        device = torch.device(self.device)
        devices = [] if device.type != "cuda" else [device.index or torch.cuda.current_device()]
        (drawn,) = np.random.SeedSequence((self._seed, self._calls)).generate_state(1, np.uint64)
        with torch.random.fork_rng(devices):
            torch.manual_seed(int(drawn))
            yield


def _robot(place: str | Mapping[str, Any]) -> EmbodimentSpec:
    from fluxvla_core.models import embodiment_in

    return embodiment_in(place) if isinstance(place, str) else EmbodimentSpec.from_dict(place)
