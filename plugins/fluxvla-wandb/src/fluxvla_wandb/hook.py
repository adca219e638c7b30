"""``WandbVideos``: the videos of a robot's episodes, sent when each has ended."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fluxvla_core import Hook, RunContext
from fluxvla_core.errors import ConfigError
from fluxvla_wandb.runs import check_mode, open_run, place, video

FOLDER = "inference"
"""Folder of a work dir that has a folder for each episode, with a video for each camera."""
_SUMMARY = "episode.json"
"""Written when an episode has ended, after its videos."""


class WandbVideos(Hook):
    """Logs each episode's videos, with its task and how it ended, to the work dir's W&B run.

    A training's metrics are the tracker's (``VLAMetric(active_trackers=("wandb",))``), into the
    same run. The run is opened with the first video.

    Args:
        project: ``WANDB_PROJECT`` by default, and ``fluxvla`` without one.
        mode: ``online`` or ``offline``; ``WANDB_MODE`` by default, and online without one.
        every: the videos of every N-th episode.
        budget_s: seconds that it may be behind the run before it is left out.

    Raises:
        ConfigError: ``mode`` is none of these, or ``every`` is less than 1.
    """

    api = "1.0"
    budget_s = 60.0

    def __init__(
        self,
        project: str | None = None,
        mode: str | None = None,
        every: int = 1,
        budget_s: float = 60.0,
    ) -> None:
        check_mode(mode, "WandbVideos")
        if every < 1:
            raise ConfigError(f"WandbVideos: every must be at least 1, got {every}")
        self.project, self.mode, self.every = project, mode, every
        self.budget_s = budget_s
        self._run: Any = None
        self._seen: set[Path] = set()
        self._episodes = 0

    def run_started(self, context: RunContext) -> None:
        self._seen = set(_episodes(Path(context.work_dir)))

    def episode_finished(self, context: RunContext) -> None:
        work_dir = Path(context.work_dir)
        # All that have ended meanwhile: this is called a moment later.
        for episode in _episodes(work_dir):
            if episode in self._seen:
                continue
            self._seen.add(episode)
            self._episodes += 1
            videos = sorted(episode.glob("*.mp4"))
            if videos and (self._episodes - 1) % self.every == 0:
                self._log(context, episode, videos)

    def _log(self, context: RunContext, episode: Path, videos: list[Path]) -> None:
        if self._run is None:
            self._run = open_run(Path(context.work_dir), self.project, self.mode)
            context.reporter.info(f"WandbVideos: videos go to {place(self._run)}")
        summary = json.loads((episode / _SUMMARY).read_text(encoding="utf-8"))
        caption = f"{summary['instruction']}: {summary['outcome']}"
        self._run.log({f"episode/{path.stem}": video(path, caption) for path in videos})

    def run_finished(self) -> None:
        if self._run is not None:
            self._run.finish()
            self._run = None


def _episodes(work_dir: Path) -> list[Path]:
    """Folders of the episodes that have ended; their files are complete."""
    return sorted(path.parent for path in (work_dir / FOLDER).glob(f"*/{_SUMMARY}"))
