"""What an evaluation's worker processes do; imported there, and light until then."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluxvla_core.evaluate.ledger import EpisodeKey

if TYPE_CHECKING:
    from fluxvla_sim.world import Scene, SimRobot, World

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
        robot: one of ``fluxvla_sim.robots.ROBOTS``.
        policy: one of ``fluxvla_sim.policies.POLICIES``.
        ckpt_path: the checkpoint's folder, where the policy needs one.
        dataset, denormalize_action: see ``load_policy``.
        height, width: of the policy's pictures; as in the checkpoint by default.
    """

    robot: str
    policy: str
    ckpt_path: str | None
    replan_every: int
    max_steps: int | None
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


class SimEvalWorker:
    """Runs episodes in one process; the policies are loaded when first needed and kept.

    Raises:
        SpecMismatch: a policy is for another robot, or wants cameras that the scene lacks.
        FluxError: a policy cannot be loaded.
    """

    def __init__(self, settings: Settings) -> None:
        from fluxvla_sim.robots import ROBOTS

        self._settings = settings
        self._robot = ROBOTS[settings.robot]
        self._scenes: dict[int, Scene] = {}
        self._policies: dict[tuple[str, int], Any] = {}

    def __call__(self, job: Job | EpisodeKey) -> dict[str, Any]:
        """The record of an episode: JSON values."""
        from fluxvla_sim.rollout import rollout

        if isinstance(job, EpisodeKey):
            job = Job(job)
        settings, key = self._settings, job.key
        name = "untrained" if key.group == UNTRAINED else settings.policy
        world, asked = self._robot.find(key.task)
        if key.group == SWAPPED:
            _, asked = self._robot.find(other_task(self._robot, key.task))
        scene = self._open(world)
        policy, cameras = self._policy(name, world)
        watch, finish = self._video(job.video, scene)
        try:
            found = rollout(
                self._robot,
                world,
                scene,
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

    def _open(self, world: World) -> Scene:
        if id(world) not in self._scenes:
            settings = self._settings
            height = max(480, settings.height or 0, settings.video_size[0])
            width = max(640, settings.width or 0, settings.video_size[1])
            self._scenes[id(world)] = world.open_scene(settings.quality, height, width)
        return self._scenes[id(world)]

    def _policy(self, name: str, world: World) -> Any:
        from fluxvla_sim.policies import NEEDS_CHECKPOINT, make_policy

        # Only an expert belongs to one world; a model is loaded once.
        known = (name, 0 if name in NEEDS_CHECKPOINT else id(world))
        if known not in self._policies:
            settings = self._settings
            policy = make_policy(
                name,
                self._robot,
                world,
                self._open(world),
                settings.ckpt_path,
                settings.device,
                settings.dataset,
                settings.denormalize_action,
                settings.mixed_precision_dtype,
            )
            self._policies[known] = policy, policy_cameras(self._robot, policy, settings)
        return self._policies[known]

    def _video(
        self, path: str | None, scene: Scene
    ) -> tuple[Callable[[], None] | None, Callable[[], None]]:
        if path is None:
            return None, lambda: None
        from fluxvla_core.record.video import VideoWriter
        from fluxvla_sim.world import CONTROL_HZ

        settings = self._settings
        stride = round(CONTROL_HZ / settings.video_fps)
        writer = VideoWriter(Path(path), CONTROL_HZ / stride, *settings.video_size)

        def watch() -> None:
            if scene.steps % stride == 0:
                writer.add(scene.render(settings.video_camera, *settings.video_size))

        return watch, writer.close


def policy_cameras(robot: SimRobot, policy: Any, settings: Settings) -> Any:
    """The cameras that ``policy`` looks at, in the sizes that it was trained with.

    Raises:
        SpecMismatch: the policy is not for this robot or these cameras.
    """
    from fluxvla_core.spec.embodiment import Camera, check_match

    known = {camera.name: camera for camera in policy.embodiment.cameras}
    scene = robot.embodiment([Camera(name, 480, 640) for name in robot.cameras])
    names = policy.cameras
    check_match(
        policy.embodiment, scene, "the policy", f"the simulated {robot.title}", cameras=names
    )
    cameras = []
    for name in names:
        trained = known.get(name, Camera(name, 480, 640))
        height = settings.height or trained.height
        width = settings.width or trained.width
        cameras.append(Camera(name, height, width))
    return tuple(cameras)


def other_task(robot: SimRobot, name: str) -> str:
    """The task of the same world whose instruction is the wrong one for ``name``."""
    names = [task.name for task in robot.find(name)[0].tasks]
    return names[(names.index(name) + 1) % len(names)]
