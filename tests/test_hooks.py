from __future__ import annotations

import dataclasses
import re
import threading
import time

import pytest

from fluxvla_core import HOOKS, Hook, RunContext
from fluxvla_core.commands import SilentReporter
from fluxvla_core.errors import ConfigError, LoadFailed
from fluxvla_core.hooks import NAMES, HookCaller, build_hooks


class Notes(SilentReporter):
    def __init__(self) -> None:
        self.warnings: list[str] = []

    def warn(self, text: str) -> None:
        self.warnings.append(text)


class Counter:
    def __init__(self, every: int = 1) -> None:
        self.every, self.seen = every, []

    def after_step(self, step, metrics):
        self.seen.append((step, metrics["loss"]))


@pytest.fixture
def context() -> RunContext:
    return RunContext(reporter=Notes())


def test_a_hook_takes_any_subset_of_the_arguments(context):
    counter = Counter()
    caller = HookCaller(context, [("Counter", counter)])
    caller.call("after_step", step=3, metrics={"loss": 0.5})
    caller.settle()
    assert counter.seen == [(3, 0.5)]


def call_until_told(context, caller):
    """Steps, as fast as they go, until a hook is left out; returns how many there were."""
    until = time.monotonic() + 20
    step = 0
    while not context.reporter.warnings:
        assert time.monotonic() < until, "nothing was told"
        step += 1
        caller.call("after_step", step=step, metrics={"loss": 0.0})
        time.sleep(0.01)
    return step


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (RuntimeError("disk on fire"), "RuntimeError: disk on fire"),
        (SystemExit(3), "SystemExit: 3"),
        (KeyboardInterrupt(), "KeyboardInterrupt: "),
    ],
)
def test_a_hook_that_raises_is_told_once_and_left_out_and_the_others_go_on(context, error, said):
    class Breaks:
        calls = 0

        def after_step(self, step):
            self.calls += 1
            raise error

    counter, breaks = Counter(), Breaks()
    caller = HookCaller(context, [("Breaks", breaks), ("Counter", counter)])
    steps = call_until_told(context, caller)
    caller.call("after_step", step=steps + 1, metrics={"loss": 0.0})
    caller.call("run_finished", outcome="ok")
    assert [s for s, _ in counter.seen] == list(range(1, steps + 2))
    assert breaks.calls == 1
    assert context.reporter.warnings == [
        f"hook Breaks.after_step raised {said}; Breaks is left out for the rest of this run"
    ]


class Sleeps:
    def __init__(self, budget_s=0.2, seconds=30.0):
        self.budget_s, self.seconds, self.calls = budget_s, seconds, 0
        self.released = threading.Event()

    def after_step(self, step):
        self.calls += 1
        self.released.wait(self.seconds)


def test_a_hook_that_sleeps_keeps_nobody_waiting_and_is_told_once_and_left_out(context):
    counter, sleeps = Counter(), Sleeps()
    caller = HookCaller(context, [("Sleeps", sleeps), ("Counter", counter)])
    began = time.monotonic()
    steps = call_until_told(context, caller)
    assert time.monotonic() - began < 10
    for step in (steps + 1, steps + 2):
        caller.call("after_step", step=step, metrics={"loss": 0.0})
    caller.settle()
    assert [s for s, _ in counter.seen] == list(range(1, steps + 3))
    assert sleeps.calls == 1
    (warning,) = context.reporter.warnings
    behind = re.fullmatch(
        r"hook Sleeps\.after_step is (\d+\.\d+) s behind the run, and may be 0\.2 s; "
        "Sleeps is left out for the rest of this run",
        warning,
    )
    assert behind, warning
    assert 0.2 <= float(behind[1]) < 10
    sleeps.released.set()


def test_a_call_takes_no_longer_for_a_hook_that_sleeps(context):
    sleeps = Sleeps(budget_s=60)
    caller = HookCaller(context, [("Sleeps", sleeps)])
    taken = []
    for step in range(200):
        began = time.perf_counter()
        caller.call("after_step", step=step, metrics={"loss": 0.0})
        taken.append(time.perf_counter() - began)
    assert sorted(taken)[100] < 0.01
    assert context.reporter.warnings == []
    sleeps.released.set()


def test_a_hook_that_is_slow_but_keeps_up_within_its_budget_is_called_with_all(context):
    sleeps = Sleeps(budget_s=30, seconds=0.02)
    caller = HookCaller(context, [("Sleeps", sleeps)])
    for step in range(20):
        caller.call("after_step", step=step, metrics={"loss": 0.0})
    caller.call("run_finished", outcome="ok")
    assert sleeps.calls == 20
    assert context.reporter.warnings == []


def test_a_hook_that_sleeps_at_the_end_of_a_run_does_not_keep_it(context):
    class Last(Sleeps):
        def run_finished(self, outcome):
            self.after_step(0)

    last = Last()
    caller = HookCaller(context, [("Last", last)])
    began = time.monotonic()
    caller.call("run_finished", outcome="ok")
    assert time.monotonic() - began < 10
    (warning,) = context.reporter.warnings
    assert re.match(r"hook Last\.run_finished is \d\.\d+ s behind the run, ", warning)
    last.released.set()


def test_what_waits_for_a_hook_is_bounded(context, monkeypatch):
    monkeypatch.setattr("fluxvla_core.hooks.MOST_WAITING", 50)
    sleeps = Sleeps(budget_s=1000)
    caller = HookCaller(context, [("Sleeps", sleeps)])
    for step in range(60):
        caller.call("after_step", step=step, metrics={"loss": 0.0})
    (warning,) = context.reporter.warnings
    assert warning.startswith("hook Sleeps.after_step keeps 51 calls waiting; Sleeps is left out")
    sleeps.released.set()


def test_a_pause_of_the_whole_process_is_no_hooks_fault(context, monkeypatch):
    """As of one that is stopped (SIGSTOP), or whose GIL somebody held."""
    sleeps = Sleeps(budget_s=5, seconds=0.3)
    caller = HookCaller(context, [("Sleeps", sleeps)])
    caller.call("after_step", step=1, metrics={"loss": 0.0})
    really = time.monotonic
    monkeypatch.setattr("fluxvla_core.hooks.time.monotonic", lambda: really() + 60)
    caller.call("after_step", step=2, metrics={"loss": 0.0})
    caller.settle()
    caller.call("after_step", step=3, metrics={"loss": 0.0})
    caller.settle()
    assert context.reporter.warnings == []
    assert sleeps.calls == 3


def test_a_thread_that_cannot_be_started_is_no_error_of_the_run(context, monkeypatch):
    def refuse(thread):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    caller = HookCaller(context, [("Counter", Counter())])
    caller.call("after_step", step=1, metrics={"loss": 0.0})
    assert context.reporter.warnings == [
        "hook Counter.after_step raised RuntimeError: can't start new thread; Counter is left out "
        "for the rest of this run"
    ]


def test_the_threads_end_with_the_run(context):
    caller = HookCaller(context, [("Ending", Counter())])
    caller.call("after_step", step=1, metrics={"loss": 0.0})
    assert "hook-Ending" in {thread.name for thread in threading.enumerate()}
    caller.call("run_finished", outcome="ok")
    until = time.monotonic() + 10
    while "hook-Ending" in {thread.name for thread in threading.enumerate()}:
        assert time.monotonic() < until
        time.sleep(0.01)


@pytest.mark.parametrize("budget", [0, -1.0, float("nan"), float("inf"), "2", True])
def test_a_budget_that_is_none_is_refused_when_it_is_built(context, budget):
    with pytest.raises(ConfigError, match="hook Sleeps: budget_s must be a positive number"):
        HookCaller(context, [("Sleeps", Sleeps(budget_s=budget))])


def test_an_argument_that_no_hook_has_is_refused_when_it_is_built(context):
    cls = type("Odd", (), {"after_step": lambda self, step, gradient: None})
    with pytest.raises(LoadFailed, match="gradient"):
        HookCaller(context, [("Odd", cls())])


def test_a_plugin_without_any_hook_is_refused(context):
    with pytest.raises(LoadFailed, match="has no method that is a hook"):
        HookCaller(context, [("Empty", object())])


def test_only_what_the_config_names_is_active(context):
    HOOKS.register_module()(Counter)
    try:
        assert not build_hooks(context)
        named = dataclasses.replace(context, config={"hooks": [{"type": "Counter", "every": 2}]})
        assert build_hooks(named)
        with pytest.raises(ConfigError, match="hooks must be a list"):
            build_hooks(dataclasses.replace(context, config={"hooks": "Counter"}))
    finally:
        HOOKS.unregister("Counter")


def test_every_hook_is_documented():
    assert len(NAMES) == 11
    for name in NAMES:
        assert getattr(Hook, name).__doc__
