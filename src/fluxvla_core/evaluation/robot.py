"""``RobotEvalRunner``: evaluates a policy's success rate on a robot.

The robot is driven by the config's inference section as it stands: its runner, its operator, all
of its safety, in real time. A simulated robot begins every episode from a seed and reports whether
the task was done; with a real one a person sets up the scene and answers whether it was. Finished
episodes are kept, so an evaluation that was interrupted can continue.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.contracts.runner import Runner
from fluxvla_core.errors import ConfigError, FluxError, RunFailed
from fluxvla_core.evaluation import results_file
from fluxvla_core.evaluation.episodes import DONE, ERROR, EpisodeKey, EvalLog, open_eval_log
from fluxvla_core.evaluation.policies import chosen_checkpoint, policy_tables
from fluxvla_core.evaluation.provenance import Code, code_of
from fluxvla_core.evaluation.videos import choose_episodes, recorded_videos

FOLDER = "eval_robot"
GROUP = "policy"
POLICY_RULES = ("chunk", "policy", "starvation", "tracking")
"""Rules of a safety stop that the policy is to blame for: the episode counts as a failure. After
any other stop it counts as an error, which says nothing about the policy."""


class RobotEvalRunner(Runner):
    """Runs an inference section ``episodes`` times for each task: ``run_setup()``, then ``run()``.

    Writes ``<work_dir>/eval_robot/``: ``results.json`` and ``episodes.jsonl``; each episode's own
    record is in ``<work_dir>/inference/``.

    Args:
        cfg: the whole config (injected).
        context: what the run knows (injected): work dir, reporter.
        section: the config's section with the inference runner.
        tasks: ids of the section's ``task_descriptions``, or name -> id, where results are to be
            compared with others that have names of their own; all of them by default.
        episodes: for each task.
        seed: seed of each task's first episode, for the policy and, where the section's operator
            takes one, for the scene; the others count up from it.
        go_on: after a safety stop, continue with the next episode. Only for robots that can hurt
            nobody: with any other a person must look first, and start the same command again.
        record_videos: how many episodes the results show: failures first, then successes.
        answer: reads a person's line; stdin by default.
        reuse: also count existing episodes that other code ran, which is an error otherwise.

    Raises:
        ConfigError: there is no such section, it has no such task, or a value is impossible.
    """

    api: ClassVar[str] = "1.0"
    keeps_config: ClassVar[bool] = True

    def __init__(
        self,
        cfg: Mapping[str, Any] | None = None,
        context: RunContext | None = None,
        section: str = "inference",
        tasks: Sequence[str] | Mapping[str, str] | None = None,
        episodes: int = 20,
        seed: int = 500,
        go_on: bool = False,
        record_videos: int = 4,
        answer: Callable[[str], str] | None = None,
        reuse: bool = False,
    ) -> None:
        self.context = context or RunContext(config=cfg or {})
        self.section = section
        self.episodes = episodes
        self.seed = seed
        self.go_on = go_on
        self.record_videos = record_videos
        self.folder = Path(self.context.work_dir) / FOLDER
        self.reuse = reuse
        self._answer = answer
        table = self.context.config.get(section)
        if not isinstance(table, Mapping):
            raise self.config_error("section", f"{section!r} is not in the config")
        self._table = dict(table)
        known = {str(key): text for key, text in table.get("task_descriptions", {}).items()}
        self.tasks = _named(tasks, known)
        for task in self.tasks.values():
            if task not in known:
                there = ", ".join(known) or "none"
                raise self.config_error(
                    "tasks", f"{task!r} is not a task of {section}; there are {there}"
                )
        if not self.tasks:
            raise self.config_error(
                "tasks", f"cannot be chosen: {section} has no task_descriptions to evaluate"
            )
        if episodes < 1:
            raise self.config_error("episodes", f"must be at least 1, got {episodes}")
        self._policy: Any = None
        self._checkpoint: dict[str, Any] | None = None

    def run_setup(self) -> None:
        """Load the policy, and see that the section can run each of the tasks.

        Raises:
            FluxError: what the section's runner refuses.
        """
        if self._table.get("policy") is None:
            work_dir = Path(self.context.work_dir)
            self._checkpoint = chosen_checkpoint(self._table.get("ckpt_path"), work_dir)
        for name in self.tasks:
            self._policy = self._runner(EpisodeKey(GROUP, name, self.seed)).policy

    def run(self) -> dict[str, Any]:
        """Run the episodes that are not there yet, write ``results.json``, return what is in it.

        Raises:
            RunFailed: it is unknown whether a task was done; an episode gave no result (the
                results of the others are written).
            UsageError: there are episodes that other code ran, and ``reuse`` is not set.
            SafetyStop, OperatorError: what ended an episode, unless ``go_on``.
        """
        reporter, keys, about = self.context.reporter, self._keys(), self._about()
        code = self._code()
        path = self.folder / "episodes.jsonl"
        log = open_eval_log(path, about, reporter, code=code.to_dict(), reuse=self.reuse)
        missing = [key for key in keys if key not in log]
        errors: dict[EpisodeKey, dict[str, Any]] = {}
        began = time.monotonic()
        if 0 < len(missing) < len(keys):
            left = len(keys) - len(missing)
            reporter.info(f"{left} of {len(keys)} episodes are there already; running the others")
        for key in missing:
            record = self._episode(key, log)
            if record["status"] == ERROR:
                errors[key] = record
            succeeded = sum(bool(r["success"]) for r in log.records(keys))
            done = len(log.records(keys)) + len(errors)
            reporter.progress("episodes", done, len(keys), successes=succeeded)
        records = [errors[key] if key in errors else log.records([key])[0] for key in keys]
        shown = choose_episodes(records, self.record_videos)
        recordings = [(r, Path(self.context.work_dir) / r["folder"]) for r in shown]
        results_file.check_any_done(records, log.path)
        found = results_file.assemble(
            records,
            log,
            policy="checkpoint" if self._checkpoint else type(self._policy).__name__,
            mode="robot",
            checkpoint=self._checkpoint,
            settings={**about["settings"], **_kept_time(records)},
            code=code,
            videos=recorded_videos(recordings, self.folder),
            timing=results_file.timing(records, len(missing), time.monotonic() - began, 1),
        )
        results_file.save_results(self.folder, found, self.context)
        results_file.check_all_done(records, log.path)
        return found

    def _keys(self) -> list[EpisodeKey]:
        seeds = range(self.seed, self.seed + self.episodes)
        return [EpisodeKey(GROUP, name, seed) for seed in seeds for name in self.tasks]

    def _about(self) -> dict[str, Any]:
        """Everything in the config that outcomes follow from."""
        table = {k: v for k, v in self._table.items() if k not in ("seed", "ckpt_path")}
        settings = {"section": self.section, **results_file.flat(results_file.as_json(table))}
        return {
            "checkpoint": None if self._checkpoint is None else self._checkpoint["sha256"],
            "settings": settings,
        }

    def _code(self) -> Code:
        tables: list[Any] = [self._table]
        if self._checkpoint is not None:
            tables += policy_tables(self._checkpoint["path"])
        return code_of(tables, (), () if self._checkpoint is None else ("torch",))

    def _runner(self, key: EpisodeKey) -> Any:
        """The section's runner for one episode: its policy is loaded once and handed on."""
        table = {**self._table, "seed": key.seed}
        if isinstance(table.get("operator"), Mapping) and "seed" in table["operator"]:
            table["operator"] = {**table["operator"], "seed": key.seed}
        if self._policy is not None:
            table["policy"] = self._policy
        context = replace(self.context, section=self.section, task=self.tasks[key.task])
        runner = build_runner_from_cfg(table, context)
        runner.run_setup()
        return runner

    def _episode(self, key: EpisodeKey, log: EvalLog) -> dict[str, Any]:
        runner = self._runner(key)
        simulated = runner.robot.simulated
        if not simulated:
            self._ask(f"{key.task}, episode {key.seed}: put things in place, then press Enter: ")
        began, failure = time.monotonic(), None
        try:
            runner.run()
        except FluxError as error:
            failure = error
        if failure is not None and (runner.recorder is None or not runner.recorder.summary):
            raise failure
        summary = runner.recorder.summary
        folder = os.path.relpath(runner.recorder.folder, self.context.work_dir)
        record: dict[str, Any] = {
            "group": key.group,
            "task": key.task,
            "seed": key.seed,
            "status": DONE,
            "attempts": 1,
            **_counted(summary, time.monotonic() - began),
            "folder": Path(folder).as_posix(),
        }
        record |= runner.episode_facts()
        rules = [trip["rule"] for trip in summary["trips"]]
        if failure is None and record["success"] is None:
            record["success"] = self._ask_success(key)
        elif failure is not None and rules[:1] and rules[0] in POLICY_RULES:
            record["success"] = False
        elif failure is not None:
            record |= {"status": ERROR, "error": str(failure)}
        log.add(record)
        self.context.reporter.event("episode", **record)
        if failure is not None:
            if not self.go_on:
                raise failure
            self.context.reporter.warn(f"{key.task}, episode {key.seed}: {failure}")
        return record

    def _ask_success(self, key: EpisodeKey) -> bool:
        while True:
            said = self._ask(f"{key.task}, episode {key.seed}: was the task done? [y/n] ")
            if said[:1].casefold() in ("y", "n"):
                return said[:1].casefold() == "y"

    def _ask(self, question: str) -> str:
        if self._answer is not None:
            return self._answer(question).strip()
        if sys.stdin is None or not sys.stdin.isatty():
            raise RunFailed(
                "this robot cannot tell whether a task was done, and nobody is there to ask",
                next="run the evaluation at a terminal, or give the operator a task_success()",
            )
        self.context.reporter.settle()
        return input(question).strip()

    def config_error(self, key: str, problem: str) -> ConfigError:
        """An error about a key of this section."""
        return self.context.error(key, problem)


def _named(
    tasks: Sequence[str] | Mapping[str, str] | None, known: Mapping[str, str]
) -> dict[str, str]:
    """Name -> id."""
    if isinstance(tasks, Mapping):
        return {str(name): str(task) for name, task in tasks.items()}
    return {str(task): str(task) for task in (known if tasks is None else tasks)}


def _counted(summary: Mapping[str, Any], seconds: float) -> dict[str, Any]:
    """The values of an episode's summary that an evaluation's record holds."""
    kept = ("success", "steps", "outcome", "problem", "instruction", "skipped_ticks")
    answers = summary["timings"].get("policy", {"count": 0, "p50_ms": 0.0})
    return {
        **{name: summary.get(name) for name in kept},
        "calls": summary["chunks"],
        "timing": {
            "seconds": seconds,
            # An episode's record keeps percentiles; the mean of answers is near the median.
            "policy_seconds": answers["count"] * answers["p50_ms"] / 1e3,
        },
    }


def _kept_time(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The lowest real-time factor that simulators report, if any does."""
    kept = [r["real_time_kept"] for r in records if r.get("real_time_kept") is not None]
    return {"least_real_time_kept": min(kept)} if kept else {}
