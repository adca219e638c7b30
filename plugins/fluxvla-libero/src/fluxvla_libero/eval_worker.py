"""What an evaluation's worker processes do; imported there, and light until then."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluxvla_core.evaluate.ledger import EpisodeKey
from fluxvla_libero.policies import Loading
from fluxvla_libero.suites import NUM_STEPS_WAIT

if TYPE_CHECKING:
    from fluxvla_libero.scene import LiberoScene
    from fluxvla_libero.suites import SuiteTask

POLICY, SWAPPED, UNTRAINED = "policy", "swapped", "untrained"
"""Groups of episodes: the policy, the policy told another task, its untrained twin."""


@dataclass(frozen=True)
class Job:
    """One episode, and where its video goes; no video by default."""

    key: EpisodeKey
    video: str | None = None


@dataclass(frozen=True)
class Settings:
    """What workers need to know; every outcome follows from it and the episode's key.

    Args:
        suite: the suite.
        tasks: names of the tasks that are evaluated; a wrong instruction is one of theirs.
        policy: one of ``fluxvla_libero.policies.POLICIES``.
        loading: how the checkpoint becomes a policy.
        seed: the policy's noise in trial ``n`` is that of ``seed + n``.
        replan_every, max_steps, num_steps_wait: see ``fluxvla_libero.rollout.Episode``.
        size: height and width of the policy's pictures; as it was trained by default.
        render: ``cheap`` or ``reference``.
        video_size, video_fps: of videos; fps divides 20.
    """

    suite: str
    tasks: tuple[str, ...]
    policy: str
    loading: Loading
    seed: int
    replan_every: int
    max_steps: int
    num_steps_wait: int = NUM_STEPS_WAIT
    size: tuple[int, int] | None = None
    render: str = "cheap"
    video_size: tuple[int, int] = (256, 256)
    video_fps: float = 10.0


class LiberoEvalWorker:
    """Runs episodes in one process. Policies are loaded when first needed and kept; of scenes only
    the last one is, because one takes hundreds of MB.

    Raises:
        SpecMismatch: a policy is for another robot, or wants cameras that LIBERO lacks.
        FluxError: a policy cannot be loaded, or LIBERO is not there.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._scene: LiberoScene | None = None
        self._policies: dict[str, Any] = {}

    def __call__(self, job: Job | EpisodeKey) -> dict[str, Any]:
        """The record of an episode: JSON values."""
        from fluxvla_libero.rollout import Episode, rollout
        from fluxvla_libero.suites import choose_tasks, init_states, suite_tasks

        if isinstance(job, EpisodeKey):
            job = Job(job)
        settings, key = self._settings, job.key
        # First of all, so that a policy that does not fit is refused before anything is built.
        name = UNTRAINED if key.group == UNTRAINED else settings.policy
        policy, cameras = self._policy(name)
        (task,) = choose_tasks(settings.suite, [key.task])
        scene = self._enter(task)
        judged = tuple(t for t in suite_tasks(settings.suite) if scene.can_judge(t))
        asked = task if key.group != SWAPPED else wrong_task(task, settings.tasks, judged)
        watch, finish = self._video(job.video, scene)
        try:
            found = rollout(
                scene,
                policy,
                Episode(
                    init_state=init_states(settings.suite, task.index)[key.seed],
                    seed=settings.seed + key.seed,
                    asked=asked,
                    cameras=cameras,
                    replan_every=settings.replan_every,
                    max_steps=settings.max_steps,
                    num_steps_wait=settings.num_steps_wait,
                    judged=judged,
                ),
                watch,
            )
        finally:
            finish()
        values = asdict(found)
        timing = {name: values.pop(name) for name in ("seconds", "policy_seconds")}
        return {**values, "instruction": asked.language, "timing": timing}

    def _enter(self, task: SuiteTask) -> LiberoScene:
        from fluxvla_libero.scene import LiberoScene

        if self._scene is None or self._scene.task != task:
            if self._scene is not None:
                self._scene.close()
            self._scene = LiberoScene(task, self._settings.render)
        return self._scene

    def _policy(self, name: str) -> Any:
        if name not in self._policies:
            from fluxvla_libero.embodiment import check_policy
            from fluxvla_libero.policies import make_policy

            policy = make_policy(name, self._settings.loading)
            self._policies[name] = policy, check_policy(policy, self._settings.size)
        return self._policies[name]

    def _video(
        self, path: str | None, scene: LiberoScene
    ) -> tuple[Callable[[Any], None] | None, Callable[[], None]]:
        if path is None:
            return None, lambda: None
        import numpy as np

        from fluxvla_core.record.video import VideoWriter
        from fluxvla_libero.embodiment import CONTROL_HZ, SCENE_CAMERAS

        height, width = self._settings.video_size
        stride = round(CONTROL_HZ / self._settings.video_fps)
        size = height, width * len(SCENE_CAMERAS)
        writer = VideoWriter(Path(path), CONTROL_HZ / stride, *size)

        def watch(action: Any) -> None:
            if scene.steps % stride == 0:
                writer.add(np.hstack([scene.render(name, height, width) for name in SCENE_CAMERAS]))

        return watch, writer.close


def wrong_task(
    task: SuiteTask, wanted: tuple[str, ...], judged: tuple[SuiteTask, ...]
) -> SuiteTask:
    """The task to ask for instead of ``task``: the next one, round and round, that could be done
    in its scene; one of ``wanted`` if there is one.

    Raises:
        ConfigError: the scene allows no other task.
    """
    from fluxvla_core.errors import ConfigError

    others = [other for other in judged if other != task and other.language != task.language]
    others = [other for other in others if other.name in wanted] or others
    if not others:
        raise ConfigError(
            f"instruction_swap: no other task of {task.suite} can be done in the scene of "
            f"{task.name!r}",
            next="evaluate without instruction_swap",
        )
    return min(others, key=lambda other: (other.index <= task.index, other.index))
