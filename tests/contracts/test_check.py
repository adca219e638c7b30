from __future__ import annotations

import pickle
import threading
from abc import abstractmethod

import pytest
from torch import nn

from fluxvla_core import VLA, Environment, Hook, Operator, Policy
from fluxvla_core.config.resolve import installed
from fluxvla_core.contracts.check import (
    check_class,
    check_operator,
    is_train_runner,
    missing_operator_methods,
)
from fluxvla_core.contracts.contract import implements, original
from fluxvla_core.errors import IncompatiblePlugin, LoadFailed
from fluxvla_core.plugins.registry import BY_NAME
from fluxvla_core.registries import REGISTRIES
from fluxvla_core.training.metrics import VLAMetric


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


class Sends:
    def get_frame(self): ...
    def send_action(self, action): ...
    def stop(self): ...


async def stop_later(self): ...


@pytest.mark.parametrize(
    ("method", "body", "problem"),
    [
        ("stop", None, "stop() is missing"),
        ("stop", 3, "stop is a int, not a method"),
        ("stop", lambda self, mode: None, "stop() must accept no argument"),
        ("stop", stop_later, "stop() is async, and nobody awaits it"),
        ("stop", abstractmethod(lambda self: None), "stop() is abstract"),
        ("send_action", lambda self, arm, action: None, "send_action() must accept 1 argument"),
        ("send_action", property(lambda self: None), "send_action is a property, not a method"),
        ("get_frame", lambda self, timeout: None, "get_frame() must accept no argument"),
        ("connect", lambda self, address: None, "connect() must accept no argument"),
        ("close", lambda self, hard: None, "close() must accept no argument"),
    ],
)
def test_an_operator_that_is_sent_actions_can_be_stopped(method, body, problem):
    check_class("operators", Sends, "here")
    with pytest.raises(LoadFailed) as caught:
        check_class("operators", type("Wrong", (Sends,), {method: body}), "here")
    assert problem in str(caught.value)


@pytest.mark.parametrize("method", ["connect", "stop", "close"])
def test_what_an_operator_of_the_specifications_shape_has_takes_what_it_is_given(method):
    shape = {"get_frame": lambda self: {}, "servoj": lambda self, joints: None}
    check_class("operators", type("Bare", (), shape), "here")
    with pytest.raises(LoadFailed, match=rf"{method}\(\) must accept no argument"):
        check_class("operators", type("Bare", (), {**shape, method: lambda self, x: None}), "here")


def test_an_attribute_that_hides_a_method_is_found_in_the_object():
    operator = Sends()
    operator.get_state = lambda: None
    check_operator(operator)

    operator.stop = threading.Event()

    with pytest.raises(LoadFailed, match=r"constructor of Sends hides .*: stop is a Event"):
        check_operator(operator)


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
        ("vlas", object, {"forward": lambda self, images: {}}, "it is not a torch.nn.Module"),
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


def test_whether_a_policy_can_go_on_from_a_chunk():
    able = type("Able", (), {"continue_action": lambda self, observation, rest: None})

    assert Policy.adapt(able()).continues
    assert not Policy.adapt(type("Unable", (able,), {"continues": False})()).continues
    assert not Policy.adapt(object()).continues


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


def test_a_class_that_inherits_must_bring_what_is_abstract():
    class Half(Operator):
        def connect(self): ...
        def get_frame(self): ...
        def send_action(self, action): ...
        def close(self): ...

    with pytest.raises(LoadFailed, match=r"stop\(\) is missing"):
        check_class("operators", Half, "here")
    check_class("operators", type("Whole", (Half,), {"stop": lambda self: None}), "here")
    body = {"stop": lambda self: None, "begin_episode": lambda self, task: None}
    with pytest.raises(LoadFailed, match=r"begin_episode\(\) must accept 2 arguments"):
        check_class("operators", type("Other", (Half,), body), "here")


@pytest.mark.parametrize(
    ("there", "lacks"),
    [("without_cameras", "without_commands"), ("without_commands", "without_cameras")],
)
@pytest.mark.parametrize("base", [object, Operator])
def test_an_operator_is_divided_into_both_parts_or_not_at_all(base, there, lacks):
    class Whole(base):
        embodiment = None

        def connect(self): ...
        def get_frame(self): ...
        def send_action(self, action): ...
        def stop(self): ...
        def close(self): ...

    check_class("operators", Whole, "here")
    half = type("Half", (Whole,), {there: lambda self: self})
    message = (
        r"here: Half does not fulfil the contract of fluxvla\.operators: "
        rf"it has {there}\(\) but no {lacks}\(\); these are needed together, or not at all"
    )
    with pytest.raises(LoadFailed, match=message):
        check_class("operators", half, "here")
    check_class("operators", type("Both", (half,), {lacks: lambda self: self}), "here")


def test_a_robot_is_not_divided_unless_its_operator_says_so():
    made = Operator.adapt(Sends())

    assert made.without_cameras() is None
    assert made.without_commands() is None


def test_a_model_that_inherits_has_a_forward_all_the_same():
    with pytest.raises(LoadFailed, match=r"it needs forward\(\), or predict_action\(\)"):
        check_class("vlas", type("Empty", (VLA, nn.Module), {}), "here")
    check_class("vlas", type("Fits", (VLA, Fit), {}), "here")


def test_a_hook_that_inherits_overrides_something():
    with pytest.raises(LoadFailed, match=r"it needs run_started\(\), or "):
        check_class("hooks", type("Typo", (Hook,), {"after_stp": lambda self, step: None}), "here")
    check_class("hooks", type("Log", (Hook,), {"after_step": lambda self, step: None}), "here")


class Scene:
    """Has what an environment must have, and inherits nothing."""

    def __init__(self):
        self.spec, self.seeds = "spec", []

    def reset(self, seed, task):
        self.seeds.append(seed)

    def step(self, action):
        return action

    def observe(self, cameras): ...
    def close(self): ...
    def own(self):
        return "own"


def test_what_inherits_nothing_gets_the_defaults_and_keeps_all_of_its_own():
    scene = Scene()
    adapted = Environment.adapt(scene)
    assert isinstance(adapted, Environment)
    assert type(adapted).__name__ == "Scene"
    adapted.reset(3, "t")
    assert (scene.seeds, adapted.step(5), adapted.own(), adapted.spec) == ([3], 5, "own", "spec")
    assert adapted.other_tasks("t") == ()
    assert (adapted.state_hash(), adapted.divergence()) == (None, None)
    scene.simulation = adapted.spec = "later"
    assert (adapted.simulation, scene.spec) == ("later", "later")
    assert original(adapted) is scene
    assert Environment.adapt(adapted) is adapted
    assert not implements(adapted, Environment, "others")
    assert implements(adapted, Environment, "step")
    with pytest.raises(AttributeError, match="Scene has no state"):
        _ = adapted.state


def test_what_was_adapted_is_adapted_again_after_pickling():
    adapted = pickle.loads(pickle.dumps(Environment.adapt(Scene())))  # noqa: S301
    assert isinstance(adapted, Environment)
    assert isinstance(original(adapted), Scene)
    assert (adapted.step(5), adapted.state_hash()) == (5, None)


def test_what_inherits_is_taken_as_it_is():
    class Still(Policy):
        def __init__(self):
            self.horizon = 3

        def reset(self, seed): ...
        def predict_action(self, observation): ...

    policy = Still()
    assert Policy.adapt(policy) is policy
    assert (policy.horizon, policy.stages) == (3, {})
    assert not hasattr(policy, "embodiment")
    assert not policy.continues


def test_an_object_that_answers_for_another_one_is_asked():
    class Logged:
        def __init__(self, operator):
            self._inner = operator

        def __getattr__(self, name):
            return getattr(self._inner, name)

    inner = type("Arm", (), {"get_frame": lambda self: 1, "task_done": lambda self: True})()
    arm = Operator.adapt(Logged(inner))
    assert arm.get_frame() == 1
    assert arm.task_done()
    assert not implements(arm, Operator, "get_state")


def test_none_in_the_place_of_a_method_is_no_method():
    arm = Operator.adapt(type("Arm", (), {"get_frame": lambda self: 1, "stop": None})())
    assert not implements(arm, Operator, "stop")
    arm.stop()


def test_a_model_that_inherits_can_be_given_another_class_as_fsdp_does():
    class Sharded:
        pass

    for bases in ((VLA, nn.Module), (nn.Module, VLA)):
        model = type("Model", bases, {})()
        model.__class__ = type("ShardedModel", (Sharded, type(model)), {})
        assert isinstance(model, Sharded)


def test_a_model_chooses_what_of_an_observation_it_takes():
    class Looks(VLA, nn.Module):
        def forward(self, x): ...
        def predict_action(self, images, lang_tokens, noise): ...
        def observe(self, images, lang_tokens, lang_masks=None): ...
        def denoise(self, seen, noise, tables): ...

    check_class("vlas", Looks, "here")
