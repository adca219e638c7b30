"""Run the stages of the demo, except finished ones, and list the results."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tools import shell
from tools.demo import outcome, stages
from tools.demo.journal import Entry, Journal, key_of
from tools.demo.next_steps import listing, next_steps
from tools.demo.outcome import clock
from tools.demo.sizes import Size, affordable_steps, expected_s, left_s
from tools.demo.stages import Places, Stage

Execute = Callable[[list[str]], object]
INSTALL = "install"


class Demo:
    """One demo in its folder.

    Args:
        size: which form.
        root: its folder; made if need be.
        build: changes when the installed code does; results of other code are not kept.
        installed_s: seconds that the installation took before.
        execute: runs a command; raises StepFailed.
        say: prints a line.
    """

    def __init__(
        self,
        size: Size,
        root: Path,
        build: str,
        installed_s: float,
        execute: Execute = shell.run,
        say: Callable[[str], None] = print,
    ) -> None:
        self.size = size
        self.places = Places(root)
        self._execute = execute
        self._say = say
        self._build = build
        root.mkdir(parents=True, exist_ok=True)
        self.journal = Journal(self.places.journal)
        install = self.journal.entries.get(INSTALL)
        if install is None or install.key != build:
            install = self.journal.entries[INSTALL] = Entry(key=build, done=True)
        install.seconds += installed_s
        self._before = ""
        self._number = 0
        self._expected = expected_s(size)
        self._took: dict[str, float] = {}

    def run(self) -> None:
        """All stages that are not done, then the summary.

        Raises:
            StepFailed: a command failed; what is done stays done.
            KeyboardInterrupt: likewise.
        """
        size, places = self.size, self.places
        limit = f"at most {size.minutes + 1:.0f} minutes" if size.minutes else "no time limit"
        self._say(f"\nFluxVLA demo, {size.name}: {limit}; everything goes to {places.root}\n")
        config = stages.CONFIG.read_text(encoding="utf-8")
        self._before = key_of(self._build, config)
        self._do(stages.collect(size, places))
        steps = self._steps()
        self._do(stages.train(size, places, steps))
        self._do(stages.evaluate(size, places))
        for task in stages.TASKS:
            self._do(stages.robot(places, task))
        self._write_stages()
        self._do(stages.report(places))
        self._summary(steps)

    def elapsed_s(self) -> float:
        """Seconds of installation and of all stages so far, over all attempts."""
        return sum(entry.seconds for entry in self.journal.entries.values())

    def _steps(self) -> int:
        if self.size.minutes is None:
            return self.size.steps

        def choose() -> dict[str, Any]:
            step_s = outcome.median_step_s(self.places.speed / "metrics.jsonl")
            steps = affordable_steps(self.size, step_s, self.elapsed_s(), self._pace())
            return {"step_s": step_s, "steps": steps}

        found = self._do(stages.measure(self.size, self.places), choose).result
        self._say(f"a step takes {found['step_s']:.2f} s: {found['steps']} steps fit\n")
        # From here on the pace of a step is known, whatever the other stages took.
        self._expected = expected_s(self.size, found["steps"], found["step_s"] / self._pace())
        return int(found["steps"])

    def _pace(self) -> float:
        """How many times longer than on a free machine the stages took so far."""
        expected = sum(self._expected[name] for name in self._took)
        return sum(self._took.values()) / expected or 1.0

    def _left(self) -> str:
        left = left_s(self._expected, self._took)
        return f"{clock(self.elapsed_s())} so far, about {clock(left)} left"

    def _do(self, stage: Stage, result: Callable[[], Any] | None = None) -> Entry:
        """Run one stage unless it is done; every later stage depends on its command."""
        self._number += 1
        key = self._before = key_of(self._before, stage.command)
        old = self.journal.entries.get(stage.name)
        head = f"stage {self._number} of {len(self._expected)}: {stage.title}"
        if old is not None and old.key == key and old.done:
            self._say(f"{head}: done before, in {clock(old.seconds)}")
            self._took[stage.name] = old.seconds
            return old
        words = list(stage.command)
        if old is not None and old.key == key:
            words += stage.resume
            entry = old
            self._say(f"{head}: going on · {self._left()}")
        else:
            self._clear(stage)
            self.journal.forget_from(stage.name)
            entry = Entry(key, command=shlex.join(stage.command))
            self._say(f"{head} · {self._left()}")
        self.journal.entries[stage.name] = entry
        self.journal.save()
        before, began = entry.seconds, time.monotonic()
        try:
            self._execute(words)
            entry.done = True
        finally:
            entry.seconds = before + time.monotonic() - began
            if entry.done and result is not None:
                entry.result = result()
            self.journal.save()
        self._took[stage.name] = entry.seconds
        self._say(f"    took {clock(entry.seconds)}\n")
        return entry

    def _clear(self, stage: Stage) -> None:
        for path in stage.clears:
            if path.exists():
                self._say(f"    {path} was made with other inputs: starting again")
                shutil.rmtree(path)

    def _write_stages(self) -> None:
        """Write the duration of each stage, for the report."""
        rows = [
            {"name": name, "seconds": entry.seconds, "command": entry.command}
            for name, entry in self.journal.entries.items()
            if name != "report"
        ]
        path = self.places.work / "stages.json"
        path.write_text(json.dumps({"stages": rows}, indent=1), encoding="utf-8")

    def _summary(self, steps: int) -> None:
        places = self.places
        checkpoints = sorted((places.work / "checkpoints").glob("step-*"))
        self._say("Done. This is what was made:")
        self._say(f"  dataset      {places.dataset} ({outcome.size_of([places.dataset])})")
        newest = checkpoints[-1]
        self._say(f"  checkpoint   {newest} ({outcome.size_of([newest])})")
        self._say(f"  evaluation   {places.work / 'eval' / 'results.json'}")
        self._say(f"  report       {places.report} ({outcome.size_of([places.report])})")
        self._say("How well it does, on seeds that it has not seen:")
        for line in outcome.verdict(places.work / "eval" / "results.json"):
            self._say(f"  {line}")
        entries = self.journal.entries.items()
        times = ", ".join(f"{name} {clock(entry.seconds)}" for name, entry in entries)
        self._say(f"Time: {clock(self.elapsed_s())} in all ({times})")
        activate = Path(sys.prefix) / "bin" / "activate"
        first = f", after: source {os.path.relpath(activate)}" if activate.is_file() else ""
        self._say(f"What to do next{first}")
        for line in listing(next_steps(self.size, places, steps)):
            self._say(line)
        sys.stdout.flush()
