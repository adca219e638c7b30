from __future__ import annotations

import pytest
from torch import nn

from fluxvla_core.config.resolve import installed
from fluxvla_core.contracts import API
from fluxvla_core.contracts.check import check_class, is_train_runner, missing_operator_methods
from fluxvla_core.contracts.methods import MAY_HAVE, NEEDS
from fluxvla_core.contracts.optional import can_continue
from fluxvla_core.errors import IncompatiblePlugin, LoadFailed
from fluxvla_core.hooks import specs
from fluxvla_core.metrics.vla_metric import VLAMetric
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


Fit = type("Fit", (nn.Module,), {"forward": lambda self, images: {}})
Index = type("Index", (), {"__len__": lambda self: 1, "get_sample": lambda self, i, epoch: {}})


@pytest.mark.parametrize(
    ("registry", "base", "body", "problem"),
    [
        ("vlas", object, {"forward": lambda self, images: {}}, "it is no torch.nn.Module"),
        ("vlas", nn.Module, {}, "it needs forward(), or predict_action()"),
        ("vlas", nn.Module, {"forward": 3}, "forward is a int, not a method"),
        ("vlas", Fit, {"fsdp_units": lambda self, x: []}, "fsdp_units() must accept no argument"),
        (
            "datasets",
            object,
            {"__len__": lambda self: 1, "__getitem__": lambda self, index: {}},
            "it needs __len__() and get_sample(), or __len__() and get_samples(), or __call__()",
        ),
        (
            "datasets",
            object,
            {"__len__": lambda self: 1, "get_sample": lambda self, index: {}},
            "get_sample() must accept 2 arguments",
        ),
        ("datasets", Index, {"get_samples": lambda self: []}, "get_samples() must accept 1 arg"),
        ("datasets", Index, {"prepare": lambda self: None}, "prepare() must accept 1 argument"),
        ("transforms", object, {}, "__call__() is missing"),
        ("collators", object, {}, "__call__() is missing"),
        ("tokenizers", object, {}, "encode() is missing"),
        ("metrics", VLAMetric, {"push": None}, "push() is missing"),
        (
            "metrics",
            VLAMetric,
            {"commit": lambda self, *, global_step, epoch, loss, lr: None},
            "commit() must accept the keywords global_step, epoch, loss, lr, any other",
        ),
        ("metrics", VLAMetric, {"finalize": lambda self, x: None}, "finalize() must accept no arg"),
        ("optimizers", object, {}, "build() is missing"),
        ("action_filters", object, {}, "__call__() is missing"),
        ("hooks", object, {"after_stp": lambda self, step: None}, "or after_step(), or"),
        ("environments", object, {}, "observe() is missing"),
        ("policies", object, {"reset": lambda self, seed: None}, "predict_action() is missing"),
        ("commands", object, {}, "add_arguments() is missing"),
    ],
)
def test_what_the_core_calls_must_be_there(registry, base, body, problem):
    with pytest.raises(LoadFailed) as caught:
        check_class(registry, type("Wrong", (base,), body), "here")
    assert problem in str(caught.value)


@pytest.mark.parametrize(
    ("registry", "cls"),
    [
        ("vlas", Fit),
        ("vlas", type("Acts", (nn.Module,), {"predict_action": lambda self, **batch: None})),
        ("datasets", Index),
        (
            "datasets",
            type("Batch", (), {"__len__": lambda self: 1, "get_samples": lambda self, keys: []}),
        ),
        ("datasets", type("Prepares", (), {"__call__": lambda self, observation: {}})),
        ("tokenizers", type("Letters", (), {"encode": lambda self, text: []})),
        ("metrics", VLAMetric),
        ("hooks", type("Log", (), {"after_step": lambda self, step: None})),
        ("heads", type("Head", (), {})),
        # Written in C, which does not always say what it takes.
        ("transforms", type("Hash", (), {"__call__": staticmethod(getattr)})),
    ],
)
def test_what_is_enough(registry, cls):
    check_class(registry, cls, "here")


def test_the_hooks_are_those_that_are_called():
    assert {name for one in NEEDS["hooks"] for name in one} == set(specs.NAMES)


def test_whether_a_policy_can_go_on_from_a_chunk():
    able = type("Able", (), {"continue_action": lambda self, observation, rest: None})

    assert can_continue(able())
    assert not can_continue(type("Unable", (able,), {"continues": False})())
    assert not can_continue(object())


def test_every_registry_has_a_contract_and_its_version():
    assert tuple(API) == tuple(NEEDS) == REGISTRIES
    assert set(MAY_HAVE) <= set(REGISTRIES)


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
