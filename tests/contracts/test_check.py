from __future__ import annotations

import pytest

from fluxvla_core.contracts.check import check_class, is_train_runner, missing_operator_methods
from fluxvla_core.errors import LoadFailed


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
