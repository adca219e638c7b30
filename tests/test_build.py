from __future__ import annotations

import pytest

import fluxvla_core
from fluxvla_core import Registry, RunContext
from fluxvla_core.build import build_from_cfg, parameters, takes
from fluxvla_core.errors import ConfigError


class Base:
    def __init__(self, rate: int = 1, cfg: dict | None = None, context: RunContext | None = None):
        self.rate, self.cfg, self.context = rate, cfg, context


class Child(Base):
    def __init__(self, own: str, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.own = own


@pytest.fixture
def registry() -> Registry:
    registry = Registry("heads")
    registry.register_module()(Base)
    registry.register_module()(Child)
    return registry


def test_keys_become_arguments_and_type_names_the_class(registry):
    assert build_from_cfg({"type": "Base", "rate": 3}, registry).rate == 3


def test_what_is_built_already_is_returned_as_it_is(registry):
    thing = object()
    assert build_from_cfg(thing, registry) is thing


def test_runtime_objects_are_filled_in_through_a_base_class(registry):
    context = RunContext(config={"a": 1})
    child = build_from_cfg({"type": "Child", "own": "x", "rate": 2}, registry, context)
    assert child.context is context
    assert child.cfg == {"a": 1}
    assert child.rate == 2


def test_a_config_may_not_set_what_the_run_fills_in(registry):
    with pytest.raises(ConfigError, match="'cfg' is filled in when the run starts"):
        build_from_cfg({"type": "Base", "cfg": {}}, registry, RunContext())


def test_wrong_arguments_name_the_class_and_the_place(registry):
    table = {"type": "Base", "rat": 2}
    context = RunContext(config={"head": table}, origins={"head": "my.py:7"})
    with pytest.raises(
        ConfigError, match="Base: got an unexpected keyword argument 'rat'"
    ) as error:
        build_from_cfg(table, registry, context)
    assert str(error.value).startswith("my.py:7: head: ")


class Counting:
    def __init__(
        self, episodes: int = 5, seed: int | None = None, tasks: dict[str, str] | None = None
    ):
        if episodes < 0 or seed == 13:
            raise ValueError("as a constructor raises it")
        self.names = tasks and sorted(tasks)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"episodes": "5"}, "'episodes' must be int, got '5'"),
        ({"tasks": 5}, "'tasks' must be dict[str, str] | None, got 5"),
        ({"episodes": [1], "seed": 2.5}, "'seed' must be int | None, got 2.5"),
    ],
)
def test_a_constructor_that_fails_at_a_value_of_another_type(registry, values, told):
    registry.register_module()(Counting)
    table = {"type": "Counting", **values}
    origins = {f"eval.head.{key}": f"config.py:{n}" for n, key in enumerate(values, 3)}
    context = RunContext(config={"eval": {"head": table}}, origins=origins)
    with pytest.raises(ConfigError) as found:
        build_from_cfg(table, registry, context)
    assert told in str(found.value)
    assert "likely cause: the constructor raised " in str(found.value)
    for key, place in origins.items():
        assert f"{place}: {key}: Counting" in str(found.value)


def test_any_other_failure_of_a_constructor_is_its_own(registry):
    registry.register_module()(Counting)
    with pytest.raises(ValueError, match="as a constructor raises it"):
        build_from_cfg({"type": "Counting", "episodes": -1, "tasks": {"a": "b"}}, registry)
    with pytest.raises(ValueError, match="as a constructor raises it") as found:
        build_from_cfg({"type": "Counting", "seed": 13}, registry)
    assert found.value.__cause__ is None


def test_a_table_without_type_is_refused(registry):
    with pytest.raises(ConfigError, match=r"fluxvla\.heads needs type = '<class name>', got None"):
        build_from_cfg({"rate": 1}, registry)


def test_the_config_itself_is_left_alone(registry):
    table = {"type": "Base", "rate": 3}
    build_from_cfg(table, registry, RunContext())
    assert table == {"type": "Base", "rate": 3}


def test_parameters_follow_keywords_into_the_base():
    assert parameters(Child) == {"own", "rate", "cfg", "context"}


def test_what_a_tables_class_takes_can_be_asked(registry):
    assert takes({"type": "Child", "own": "x"}, registry, "rate")
    assert takes({"type": Child}, registry, "own")
    assert not takes({"type": "Base"}, registry, "own")
    assert not takes(Base(), registry, "rate"), "it is built already"
    with pytest.raises(ConfigError, match="needs type = '<class name>'"):
        takes({}, registry, "rate")


def test_public_names_are_pinned_and_lazy():
    assert set(fluxvla_core.__all__) >= {
        "RUNNERS",
        "OPERATORS",
        "BaseTrainRunner",
        "BaseInferenceRunner",
        "build_runner_from_cfg",
        "build_operator_from_cfg",
    }
    with pytest.raises(AttributeError, match="no attribute 'Nope'"):
        fluxvla_core.Nope  # noqa: B018
