from __future__ import annotations

import dataclasses

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


class Breaks:
    def after_step(self, step):
        raise RuntimeError("disk on fire")


@pytest.fixture
def context() -> RunContext:
    return RunContext(reporter=Notes())


def test_a_hook_takes_any_subset_of_the_arguments(context):
    counter = Counter()
    HookCaller(context, [("Counter", counter)]).call("after_step", step=3, metrics={"loss": 0.5})
    assert counter.seen == [(3, 0.5)]


def test_a_hook_that_raises_is_reported_and_left_out_and_the_others_go_on(context):
    counter = Counter()
    caller = HookCaller(context, [("Breaks", Breaks()), ("Counter", counter)])
    for step in (1, 2):
        caller.call("after_step", step=step, metrics={"loss": 0.0})
    assert [s for s, _ in counter.seen] == [1, 2]
    (warning,) = context.reporter.warnings
    assert "hook Breaks.after_step raised RuntimeError: disk on fire" in warning


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
    assert len(NAMES) == 10
    for name in NAMES:
        assert getattr(Hook, name).__doc__
