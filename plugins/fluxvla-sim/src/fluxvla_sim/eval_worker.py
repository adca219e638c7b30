"""What an evaluation's worker processes do; imported there, and light until then."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluxvla_core.evaluate.ledger import EpisodeKey

if TYPE_CHECKING:
    from fluxvla_sim.aloha.scene import AlohaScene

POLICY, SWAPPED, UNTRAINED = "policy", "swapped", "untrained"
"""Groups of episodes: the policy, the policy told the other task, its untrained twin."""


@dataclass(frozen=True)
class Job:
    """One episode, and where its video goes; no video by default."""

    key: EpisodeKey
    video: str | None = None


@dataclass(frozen=True)
class Settings:
    """What workers need to know; every outcome follows from it and the episode's key.

    Args:
        policy: one of ``fluxvla_sim.aloha.policies.POLICIES``.
        ckpt_path: the checkpoint's folder, where the policy needs one.
        dataset, denormalize_action: see ``load_policy``.
        height, width: of the policy's pictures; as in the checkpoint by default.
    """

    policy: str
    ckpt_path: str | None
    replan_every: int
    max_steps: int
    quality: str
    device: str
    mixed_precision_dtype: str
    dataset: Any
    denormalize_action: Any
    height: int | None
    width: int | None
    video_camera: str
    video_size: tuple[int, int]
    video_fps: float


class AlohaEvalWorker:
    """Runs episodes in one process; the policies are loaded when first needed and kept.

    Raises:
        SpecMismatch: a policy is for another robot, or wants cameras that the scene lacks.
        FluxError: a policy cannot be loaded.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._scene: AlohaScene | None = None
        self._policies: dict[str, Any] = {}

    def __call__(self, job: Job | EpisodeKey) -> dict[str, Any]:
        """The record of an episode: JSON values."""
        from fluxvla_sim.aloha.rollout import rollout
        from fluxvla_sim.aloha.tasks import get_task

        if isinstance(job, EpisodeKey):
            job = Job(job)
        settings, key = self._settings, job.key
        name = "untrained" if key.group == UNTRAINED else settings.policy
        policy, cameras = self._policy(name)
        asked = get_task(key.task if key.group != SWAPPED else other_task(key.task))
        watch, finish = self._video(job.video)
        try:
            found = rollout(
                self._open_scene(),
                policy,
                asked,
                asked.instruction,
                key.seed,
                cameras,
                settings.replan_every,
                settings.max_steps,
                watch,
            )
        finally:
            finish()
        values = asdict(found)
        timing = {name: values.pop(name) for name in ("seconds", "policy_seconds")}
        success = found.behaviours[key.task]
        return {**values, "success": success, "instruction": asked.instruction, "timing": timing}

    def _open_scene(self) -> AlohaScene:
        from fluxvla_sim.aloha.scene import AlohaScene

        if self._scene is None:
            settings = self._settings
            height = max(480, settings.height or 0, settings.video_size[0])
            width = max(640, settings.width or 0, settings.video_size[1])
            self._scene = AlohaScene(settings.quality, height, width)
        return self._scene

    def _policy(self, name: str) -> Any:
        if name not in self._policies:
            from fluxvla_sim.aloha.policies import make_policy

            settings = self._settings
            policy = make_policy(
                name,
                self._open_scene(),
                settings.ckpt_path,
                settings.device,
                settings.dataset,
                settings.denormalize_action,
                settings.mixed_precision_dtype,
            )
            self._policies[name] = policy, policy_cameras(policy, settings)
        return self._policies[name]

    def _video(self, path: str | None) -> tuple[Callable[[], None] | None, Callable[[], None]]:
        if path is None:
            return None, lambda: None
        from fluxvla_core.record.video import VideoWriter
        from fluxvla_sim.aloha.scene import CONTROL_HZ

        settings, scene = self._settings, self._open_scene()
        stride = round(CONTROL_HZ / settings.video_fps)
        writer = VideoWriter(Path(path), CONTROL_HZ / stride, *settings.video_size)

        def watch() -> None:
            if scene.steps % stride == 0:
                writer.add(scene.render(settings.video_camera, *settings.video_size))

        return watch, writer.close


def policy_cameras(policy: Any, settings: Settings) -> Any:
    """The cameras that ``policy`` looks at, in the sizes that it was trained with.

    Raises:
        SpecMismatch: the policy is not for this robot or these cameras.
    """
    from fluxvla_aloha.embodiment import aloha_spec

    from fluxvla_core.spec.embodiment import Camera, check_match
    from fluxvla_sim.operators import ALOHA_CAMERAS

    known = {camera.name: camera for camera in policy.embodiment.cameras}
    scene = aloha_spec([Camera(name, 480, 640) for name in ALOHA_CAMERAS])
    names = policy.cameras
    check_match(policy.embodiment, scene, "the policy", "the simulated ALOHA", cameras=names)
    cameras = []
    for name in names:
        trained = known.get(name, Camera(name, 480, 640))
        height = settings.height or trained.height
        width = settings.width or trained.width
        cameras.append(Camera(name, height, width))
    return tuple(cameras)


def other_task(name: str) -> str:
    """The task whose instruction is the wrong one for ``name``."""
    from fluxvla_sim.aloha.tasks import TASKS

    names = list(TASKS)
    return names[(names.index(name) + 1) % len(names)]
