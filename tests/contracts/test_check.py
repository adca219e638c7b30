from __future__ import annotations

import pytest

from fluxvla_core.config.resolve import installed
from fluxvla_core.contracts import API
from fluxvla_core.contracts.check import check_class, is_train_runner, missing_operator_methods
from fluxvla_core.contracts.optional import can_continue
from fluxvla_core.errors import IncompatiblePlugin, LoadFailed
from fluxvla_core.plugins.groups import REGISTRIES
from fluxvla_core.plugins.registry import BY_NAME


class Train:
    def run_setup(self, n_train_examples): ...
    def run(self, vla_dataset): ...


class Eval:
    def run_setup(self): ...
    def run(self): ...


def test_a_train_runner_is_told_by_what_its_set_up_takes():
    assert is_train_runner(Train)
    assert not is_train_runner(Eval)
    check_class("runners", Train, "here")
    check_class("runners", Eval, "here")


def test_a_train_runner_whose_run_takes_no_dataset_is_refused():
    cls = type("Half", (Train,), {"run": lambda self: None})
    with pytest.raises(LoadFailed, match=r"run\(\) must accept 1 argument"):
        check_class("runners", cls, "here")


def test_static_and_class_methods_count_as_methods():
    cls = type(
        "Static",
        (),
        {"run": staticmethod(lambda: None), "run_setup": classmethod(lambda cls: None)},
    )
    check_class("runners", cls, "here")


def test_every_missing_method_is_named_at_once():
    with pytest.raises(LoadFailed) as error:
        check_class("runners", type("Empty", (), {}), "fluxvla-x 1.0")
    assert "run() is missing; run_setup() is missing" in str(error.value)
    assert "fluxvla-x 1.0: Empty" in str(error.value)


def test_what_an_operator_of_the_specifications_shape_lacks():
    class Partial:
        def get_frame(self): ...
        def servoj(self, q): ...

    lacks = missing_operator_methods(Partial())
    assert lacks == ["embodiment", "connect()", "send_action()", "stop()", "close()"]


@pytest.mark.parametrize(
    ("registry", "required", "method", "problem"),
    [
        ("operators", "get_frame", "get_state", "get_state() must accept no argument"),
        ("operators", "get_frame", "task_done", "task_done() must accept no argument"),
        ("operators", "get_frame", "task_success", "task_success() must accept no argument"),
        ("operators", "get_frame", "begin_episode", "begin_episode() must accept 2 arguments"),
        ("action_filters", None, "bind", "bind() must accept 1 argument"),
        ("action_filters", None, "reset", "reset() must accept 1 argument"),
    ],
)
def test_what_a_class_may_have_besides_must_take_what_it_is_given(
    registry, required, method, problem
):
    body = {"__call__": lambda self, action: action}
    if required is not None:
        body[required] = lambda self: None
    check_class(registry, type("Plain", (), body), "here")
    cls = type("Wrong", (), {**body, method: lambda self, a, b, c: None})
    with pytest.raises(LoadFailed) as caught:
        check_class(registry, cls, "here")
    assert problem in str(caught.value)


def test_an_action_filter_is_called_with_an_action():
    cls = type("Lazy", (), {"__call__": lambda self: None})
    with pytest.raises(LoadFailed, match=r"Lazy .*__call__\(\) must accept 1 argument"):
        check_class("action_filters", cls, "here")


def test_whether_a_policy_can_go_on_from_a_chunk():
    able = type("Able", (), {"continue_action": lambda self, observation, rest: None})

    assert can_continue(able())
    assert not can_continue(type("Unable", (able,), {"continues": False})())
    assert not can_continue(object())


def test_every_contract_has_a_version():
    assert tuple(API) == REGISTRIES


@pytest.mark.parametrize("registry", REGISTRIES)
def test_a_class_for_another_contract_is_refused_in_every_registry(install, registry):
    """When it is registered, when it is loaded, and by a check that imports nothing."""
    install(
        "acme-late",
        entry_points=f"[fluxvla.{registry}]\nLate = acme_late:Late\n",
        files={"acme_late.py": "class Late:\n    api = '9.0'\n"},
    )
    there = BY_NAME[registry]
    message = rf"Late is written for {registry} 9\.0, this core speaks 1\.0"
    with pytest.raises(IncompatiblePlugin, match=message):
        there.register_module()(type("Late", (), {"api": "9.0"}))
    with pytest.raises(IncompatiblePlugin, match=message):
        there.get("Late")
    with pytest.raises(IncompatiblePlugin, match=message):
        installed(*there.installed()["Late"])
