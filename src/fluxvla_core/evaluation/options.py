"""The settings of ``EvalRunner``, checked before anything is built."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fluxvla_core.build import RunContext
from fluxvla_core.errors import ConfigError
from fluxvla_core.evaluation.live import live_options
from fluxvla_core.evaluation.policies import CHECKPOINT, PolicySource
from fluxvla_core.evaluation.rollout import RolloutSettings


@dataclass(frozen=True, kw_only=True)
class EvalOptions:
    """The settings of an evaluation; its runner's constructor and ``plugins show`` are made from
    them."""

    environment: Mapping[str, Any] | None = None
    """table of a registered environment."""
    policy: str | Mapping[str, Any] = CHECKPOINT
    """``checkpoint``, ``untrained``, ``expert`` (the environment's own), ``random``, or the table
    of a registered policy."""
    ckpt_path: str | None = None
    """checkpoint or work dir; the newest undamaged one of the work dir by default."""
    dataset: Any = None
    """instead of what the checkpoint says, see ``load_policy``."""
    denormalize_action: Any = None
    """instead of what the checkpoint says, see ``load_policy``."""
    norm_stats_key: str | None = None
    """which of the checkpoint's statistics."""
    height: int | None = None
    """height of the policy's images; as in its training data by default."""
    width: int | None = None
    """width of the policy's images; as in its training data by default."""
    device: str = "cpu"
    """torch device of the policy."""
    mixed_precision_dtype: str = "float32"
    """precision of the policy: ``float32`` or ``bf16``."""
    execution: str = "eager"
    """how the policy's model computes, see ``load_policy``."""
    quantization: str | None = None
    """how the policy's model computes, see ``load_policy``."""

    tasks: Sequence[str] | None = None
    """names of the tasks; all by default."""
    episodes: int = 50
    """for each task."""
    seed: int = 0
    """seed of each task's first episode; the others count up from it."""
    policy_seed: int = 0
    """the policy's seed is this more than the episode's."""
    replan_every: int | None = None
    """how many actions of a chunk are executed before the policy is queried again; all of them by
    default."""
    max_steps: int | None = None
    """control steps after which an episode ends, instead of the environment's."""
    instruction_swap: bool = False
    """also give the policy another task's instruction, and test whether the right one does
    better."""
    swap_seed: int | None = None
    """seed of the first of these episodes; by default they repeat those of the policy."""
    baseline: bool = False
    """also evaluate the same model with fresh random weights, on the same seeds."""
    live: bool | Mapping[str, Any] = False
    """on the wall clock, through the control loop and the safety of a robot, into
    ``<work_dir>/eval_live/``: True, or a table with those keys of an inference runner that
    ``live.LIVE_OPTIONS`` lists. Slow policies miss ticks; outcomes depend on the machine."""

    workers: int | None = None
    """processes that simulate, 2 by default and 1 live; ``--nproc`` overrides it."""
    batch_size: int = 1
    """rows of every forward pass of the policy. Results follow from it, because sums do; they do
    not follow from how many of the rows were in use."""
    serve_policy: bool | None = None
    """one model in this process answers all workers, in batches; otherwise each worker has its own.
    Changes nothing but time and memory; by default True where ``batch_size`` is above 1 or the
    device is not a CPU."""
    episode_timeout_s: float = 1800.0
    """an episode that takes longer is tried again in a new process."""
    reuse: bool = False
    """also count existing episodes that other code ran (other versions, changed plugins), which is
    an error otherwise."""

    record_videos: int = 4
    """how many episodes to show: failures first, then successes."""
    video_cameras: Sequence[str] | None = None
    """side by side; the environment's first by default."""
    video_height: int | None = None
    """of each camera's image; the environment's own by default."""
    video_width: int | None = None
    """of each camera's image; the environment's own by default."""
    video_fps: float = 10.0
    """frames a second."""

    def check(self, context: RunContext) -> None:
        """Refuse values that no evaluation can have.

        Raises:
            ConfigError: with the place of its key.
        """
        for name, value, least in (
            ("episodes", self.episodes, 1),
            ("workers", self.workers, 1),
            ("batch_size", self.batch_size, 1),
            ("replan_every", self.replan_every, 1),
            ("max_steps", self.max_steps, 1),
            ("record_videos", self.record_videos, 0),
            ("seed", self.seed, 0),
            ("swap_seed", self.swap_seed, 0),
        ):
            if value is not None and value < least:
                raise context.error(name, f"must be at least {least}, got {value}")
        if (self.height is None) != (self.width is None):
            raise context.error("height", "and width belong together: give both or none")
        if self.video_fps <= 0:
            raise context.error("video_fps", f"must be positive, got {self.video_fps:g}")
        try:
            live = live_options(self.live)
        except ConfigError as error:
            raise context.error("live", error.what) from error
        if live is not None and self.instruction_swap:
            raise context.error("instruction_swap", "cannot be live: evaluate it stepped")

    @property
    def first_swap_seed(self) -> int:
        """``swap_seed``, or its default."""
        return self.seed if self.swap_seed is None else self.swap_seed

    @property
    def serves_policy(self) -> bool:
        """``serve_policy``, or its default."""
        if self.serve_policy is not None:
            return self.serve_policy
        return self.batch_size > 1 or not self.device.startswith("cpu")

    @property
    def size(self) -> tuple[int, int] | None:
        """Height and width of the policy's images; None as in its training data."""
        return None if self.height is None or self.width is None else (self.height, self.width)

    @property
    def rollout(self) -> RolloutSettings:
        """The settings of each episode; its cameras are known once the policy is."""
        return RolloutSettings((), self.replan_every, self.max_steps, self.policy_seed)

    def source(self, policy: str | Mapping[str, Any], ckpt_path: str | None) -> PolicySource:
        """From what each worker builds or loads ``policy``."""
        return PolicySource(
            policy=policy,
            ckpt_path=ckpt_path,
            dataset=self.dataset,
            denormalize_action=self.denormalize_action,
            norm_stats_key=self.norm_stats_key,
            device=self.device,
            precision=self.mixed_precision_dtype,
            batch_size=self.batch_size,
            execution=self.execution,
            quantization=self.quantization,
        )
