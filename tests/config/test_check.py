"""Checking a config against the classes that it names: every finding, all of them at once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from fluxvla_core import OPERATORS, RUNNERS
from fluxvla_core.config.check import check_config, examine
from fluxvla_core.config.load import load_config
from fluxvla_core.config.overrides import apply_overrides
from tests.conftest import Install

from .conftest import Write
from .toy import GOOD, _toy, findings

__all__ = ["_toy"]


def test_a_good_config(write: Write) -> None:
    checked = check_config(load_config(write("c.py", GOOD)))
    assert checked.sections == ("runner", "inference")
    assert checked.trains == {"runner"}
    assert [(u.key, u.found.registry, u.found.origin) for u in checked.uses] == [
        ("model", "vlas", "fluxvla-toy 1.0"),
        ("train_dataloader.dataset", "datasets", "fluxvla-toy 1.0"),
        ("train_dataloader.dataset.transforms.0", "transforms", "fluxvla-toy 1.0"),
        ("runner", "runners", "fluxvla-toy 1.0"),
        ("inference", "runners", "fluxvla-toy 1.0"),
        ("inference.operator", "operators", "fluxvla-toy 1.0"),
    ]


def test_an_unknown_key(write: Write) -> None:
    text = findings(GOOD.replace("max_epochs=1", "max_epochs=1,\n  warmup_rato=0.1"), write)
    assert text == (
        "1 problem in the config:\n"
        "  c.py:7: runner.warmup_rato: ToyTrainRunner takes no 'warmup_rato'; "
        "did you mean 'warmup_ratio'? (defined at toy/runners.py:3)"
    )
    text = findings(GOOD.replace("max_epochs=1", "max_epochs=1, zzz=0.1"), write)
    assert "ToyTrainRunner takes no 'zzz' (defined at toy/runners.py:4)" in text


@pytest.mark.parametrize(
    ("annotation", "known"),
    [
        ("Blur", True),
        ("Blur | None", True),
        ("'Blur | None'", True),
        ("Optional[Blur]", True),
        ("Blur | Mapping[str, Any] | None", True),
        ("settings.Blur", True),
        ("Sharp | None", True),
        ("Mapping[str, Any]", False),
        ("Blur | str", False),
        ("Blur | Sharp", False),
        ("Own | None", False),
        ("Foreign", False),
        ("list[Blur]", False),
        ("Gone", False),
    ],
)
def test_a_key_of_a_table_whose_parameter_names_a_dataclass(
    annotation: str, known: bool, install: Install, write: Write
) -> None:
    points = "[fluxvla.transforms]\nToyBlur = blur.pixels:ToyBlur\n"
    files = {
        "blur/__init__.py": "raise RuntimeError('a check must not import')\n",
        "blur/settings.py": "from dataclasses import dataclass\n"
        "from typing import TypedDict\n"
        "from nowhere import Anything\n"
        "@dataclass\nclass Edge:\n    mode: str = 'wrap'\n"
        "@dataclass\nclass Base:\n    sigma: float\n"
        "@dataclass\nclass Blur(Base):\n    radius: int = 3\n    edge: Edge | None = None\n"
        "class Plain(TypedDict):\n    sigma: float\n"
        "class Sharp(Plain, total=False):\n    radius: int\n    edge: Edge\n"
        "@dataclass\nclass Own:\n    a: int\n    def __init__(self, **keys): ...\n"
        "@dataclass\nclass Foreign(Anything):\n    a: int\n",
        "blur/pixels.py": "from collections.abc import Mapping\n"
        "from typing import Any, Optional\n"
        "from blur import settings\n"
        "from blur.settings import Blur, Foreign, Own, Sharp\n"
        f"class ToyBlur:\n    def __init__(self, blur: {annotation} = None): ...\n",
    }
    install("fluxvla-blur", entry_points=points, files=files)
    resize = "dict(type='ToyResize', height=1, width=2)"
    given = "dict(type='ToyBlur', blur=dict(\n radus=3, edge=dict(mod='wrap')))"
    config = load_config(write("c.py", GOOD.replace(resize, given)))
    where = "train_dataloader.dataset.transforms.0.blur"
    name = "Sharp" if "Sharp" in annotation else "Blur"
    places = {"Blur": 12, "Sharp": 17}
    assert [str(problem) for problem in examine(config).problems] == [
        f"c.py:6: {where}.radus: {name} takes no 'radus'; did you mean 'radius'? "
        f"(defined at blur/settings.py:{places[name]})",
        f"c.py:6: {where}.edge.mod: Edge takes no 'mod'; did you mean 'mode'? "
        "(defined at blur/settings.py:6)",
    ][: 2 if known else 0]


def test_a_misspelt_key_next_to_the_inherited_one(write: Write) -> None:
    write("base.py", GOOD.replace("max_epochs=1", "max_epochs=1,\n  learning_rate=1e-3"))
    path = write("c.toml", "_base_ = 'base.py'\n[runner]\nmax_epoch = 2\nlearning_rte = 1.0\n")
    config = apply_overrides(load_config(path), ["runner.learning_rat+=1"])
    assert [str(problem) for problem in examine(config).problems] == [
        "c.toml:3: runner.max_epoch: ToyTrainRunner takes no 'max_epoch'; did you mean "
        "'max_epochs'? (set at base.py:6)",
        "c.toml:4: runner.learning_rte: ToyTrainRunner takes no 'learning_rte'; did you mean "
        "'learning_rate'? (set at base.py:7)",
        "--set runner.learning_rat+=1: runner.learning_rat: ToyTrainRunner takes no "
        "'learning_rat'; did you mean 'learning_rate'? (set at base.py:7)",
    ]


def test_all_problems_at_once_in_the_order_of_the_file(write: Write) -> None:
    text = findings(
        """\
        model = dict(type='ToyVLB')
        train_dataloader = dict(dataset=dict(type='ToyDataset', data_root='d',
            transforms=[dict(type='ToyResize', height=1), 3, dict(height=1)]))
        runner = dict(type='ToyTrainRunner', cfg=1, context=2)
        inference = dict(type=7, operator=dict(topic='/a'))
        eval = 'ToyEval'
        modl = dict(a=1)
        """,
        write,
    )
    assert text.splitlines() == [
        "13 problems in the config:",
        "  c.py:1: model.type: no fluxvla.vlas plugin named 'ToyVLB'; did you mean 'ToyVLA'?",
        "  c.py:2: train_dataloader.dataset: ToyDataset needs 'data_root_path' "
        "(defined at toy/data.py:2)",
        "  c.py:2: train_dataloader.dataset.data_root: ToyDataset takes no 'data_root'; "
        "did you mean 'data_root_path'? (defined at toy/data.py:3)",
        "  c.py:3: train_dataloader.dataset.transforms.0: ToyResize needs 'width' "
        "(defined at toy/data.py:4)",
        "  c.py:3: train_dataloader.dataset.transforms.1: must be a table with "
        "type = '<one of fluxvla.transforms>', got 3",
        "  c.py:3: train_dataloader.dataset.transforms.2: this table needs "
        "type = '<one of fluxvla.transforms>'",
        "  c.py:4: runner: ToyTrainRunner needs 'max_epochs' (defined at toy/runners.py:4)",
        "  c.py:4: runner.cfg: 'cfg' is filled in when the run starts and cannot be set",
        "  c.py:4: runner.context: 'context' is filled in when the run starts and cannot be set",
        "  c.py:5: inference.type: type must be a class's name in quotes, got 7",
        "  c.py:5: inference.operator: this table needs type = '<one of fluxvla.operators>'",
        "  c.py:6: eval: must be a table with type = '<one of fluxvla.runners>', got 'ToyEval'",
        "  c.py:7: modl: no section of that name; did you mean 'model'? (if it is a variable of "
        "your own, give it a name that looks less like one)",
        "  next: fluxvla plugins list",
    ]


def test_sections_and_loaders_of_the_wrong_shape(write: Write) -> None:
    text = findings(
        """\
        runner = dict(max_epochs=1)
        train_dataloader = 3
        """,
        write,
    )
    assert "runner: this table needs type = '<one of fluxvla.runners>'" in text
    assert "train_dataloader: must be a table, got 3" in text


def test_a_train_section_needs_a_dataset(write: Write) -> None:
    runner = "runner = dict(type='ToyTrainRunner', max_epochs=1)\n"
    assert (
        "c.py:1: runner: 'runner' trains, and there is no train_dataloader = "
        "dict(dataset=dict(...))"
    ) in findings(runner, write)
    text = findings(runner + "train_dataloader = dict(per_device_batch_size=1)\n", write)
    assert "c.py:2: train_dataloader: needs dataset = dict(type=...)" in text


def test_a_typo_beside_the_dataset(write: Write) -> None:
    text = findings(GOOD.replace("per_device_batch_size", "per_device_batchsize"), write)
    assert text.endswith(
        "c.py:3: train_dataloader.per_device_batchsize: unknown key; "
        "did you mean 'per_device_batch_size'?"
    )
    theirs = GOOD.replace("per_device_batch_size=8", "shards=8")
    assert examine(load_config(write("c.py", theirs))).problems == ()


def test_none_switches_parts_off(write: Write) -> None:
    text = GOOD + "eval = None\nval_dataloader = None\n"
    checked = check_config(load_config(write("c.py", text)))
    assert checked.sections == ("runner", "inference")


def test_a_class_of_another_registry(write: Write) -> None:
    text = findings(GOOD.replace("'ToyOperator'", "'ToyTrainRunner'"), write)
    assert (
        "c.py:8: inference.operator.type: 'ToyTrainRunner' is one of fluxvla.runners, "
        "and this key takes fluxvla.operators"
    ) in text


def test_a_first_party_plugin_that_is_not_installed(
    write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FLUXVLA_PLUGINS", "toy")
    text = findings(GOOD.replace("'ToyTrainRunner'", "'FSDPTrainRunner'"), write)
    assert (
        "c.py:6: runner.type: no fluxvla.runners plugin named 'FSDPTrainRunner'; fluxvla-fsdp "
        "provides it and is not installed: pip install fluxvla-fsdp"
    ) in text
    assert text.endswith("next: fluxvla plugins list")
    text = findings("mine = dict(type='FSDPTrainRunner')\n", write)
    assert (
        "c.py:1: mine.type: no plugin named 'FSDPTrainRunner'; fluxvla-fsdp provides it and is "
        "not installed: pip install fluxvla-fsdp"
    ) in text


def test_other_sections_may_lack_their_plugins(write: Write) -> None:
    text = GOOD.replace("'ToyTrainRunner'", "'FarTrainRunner'").replace("'ToyVLA'", "'FarVLA'")
    config = load_config(write("c.py", text))
    assert check_config(config, "inference").sections == ("runner", "inference")
    assert len(examine(config, "runner").problems) == 2
    assert len(examine(config).problems) == 2

    config = load_config(write("d.py", GOOD.replace("'ToyOperator'", "'FarOperator'")))
    assert examine(config, "runner").problems == ()
    assert len(examine(config, "inference").problems) == 1


def test_but_typos_in_other_sections_count(write: Write) -> None:
    text = findings(GOOD.replace("max_epochs=1", "max_epoch=1"), write, "inference")
    assert "runner.max_epoch" in text


def test_variables_may_be_incomplete_but_not_wrong(write: Write) -> None:
    variables = """\
resize = dict(type='ToyResize', height=1)
sizes = dict(small=dict(type='ToyResize'), lora=dict(r=8))
layers = [dict(type='ToyResize')]
"""
    assert examine(load_config(write("c.py", GOOD + variables))).problems == ()
    text = findings(GOOD + "resize = dict(type='ToyResize', hight=1)\n", write)
    assert "resize.hight: ToyResize takes no 'hight'; did you mean 'height'?" in text
    text = findings(GOOD + "resize = dict(type='ToyResizer')\n", write)
    assert (
        "resize.type: no plugin named 'ToyResizer' in any registry; did you mean 'ToyResize'?"
    ) in text


def test_a_section_of_another_name_is_a_section(write: Write) -> None:
    text = GOOD + "spare = dict(type='ToyInferenceRunner')\n"
    assert "spare: ToyInferenceRunner needs 'operator', 'task_descriptions'" in findings(
        text, write
    )


def test_a_key_left_over_from_a_replaced_class(write: Write) -> None:
    write("base.py", GOOD)
    text = findings(
        "_base_ = 'base.py'\ninference = dict(operator=dict(type='ToySimOperator'))\n", write
    )
    assert (
        "base.py:8: inference.operator.topic: ToySimOperator takes no 'topic' (defined at "
        "toy/robot.py:4); it was written for the class that c.py:2 replaced: add _delete_=True "
        "to that table, or override the whole table 'inference.operator'"
    ) in text
    text = findings(GOOD, write, None, "inference.operator.type=ToySimOperator")
    assert text.endswith(
        "it was written for the class that --set inference.operator.type=ToySimOperator replaced: "
        "set the whole table: --set 'inference.operator={type = ...}'"
    )
    config = apply_overrides(
        load_config("c.py"), ['inference.operator={type = "ToySimOperator", seed = 3}']
    )
    assert examine(config).problems == ()


def test_a_key_left_over_through_several_files(write: Write) -> None:
    write("base.py", GOOD)
    write("sim.py", "_base_ = 'base.py'\ninference = dict(operator=dict(type='ToySimOperator'))\n")
    text = findings("_base_ = 'sim.py'\n", write)
    assert "it was written for the class that sim.py:2 replaced: add _delete_=True" in text
    path = write("c.toml", "_base_ = 'sim.py'\n[inference.operator]\ntopic = '/b'\n")
    (problem,) = examine(load_config(path)).problems
    assert problem.what == "ToySimOperator takes no 'topic' (defined at toy/robot.py:4)"


def test_a_key_left_over_that_also_looks_misspelt(write: Write) -> None:
    write("base.py", GOOD.replace("topic='/a'", "topic='/a', seeds=3"))
    text = findings(
        "_base_ = 'base.py'\ninference = dict(operator=dict(type='ToySimOperator'))\n", write
    )
    assert (
        "ToySimOperator takes no 'seeds'; did you mean 'seed'? (defined at toy/robot.py:5); or it "
        "was written for the class that c.py:2 replaced: add _delete_=True"
    ) in text


@pytest.mark.parametrize("text", ["topic = '/b'", "type = 'ToySimOperator'\ntopic = '/b'"])
def test_a_key_written_for_the_class_that_is_there_is_not_left_over(
    write: Write, text: str
) -> None:
    write("base.py", GOOD.replace("'ToyOperator', topic='/a'", "'ToySimOperator'"))
    path = write("c.toml", f"_base_ = 'base.py'\n[inference.operator]\n{text}\n")
    config = load_config(path)
    for key in ("rate", "zzz"):
        config = apply_overrides(config, [f"inference.operator.{key}+=1"])
    assert [problem.what for problem in examine(config).problems] == [
        f"ToySimOperator takes no {name!r} (defined at toy/robot.py:4)"
        for name in ("topic", "rate", "zzz")
    ]


def test_a_side_by_side_base_replaces_no_class(write: Write) -> None:
    write("robot.py", GOOD.replace("'ToyOperator', topic='/a'", "'ToySimOperator'"))
    write("more.py", "inference = dict(operator=dict(topic='/b'))\n")
    text = findings("_base_ = ['more.py', 'robot.py']\n", write)
    assert text.endswith("ToySimOperator takes no 'topic' (defined at toy/robot.py:4)")


def test_hooks_are_names_or_tables(write: Write) -> None:
    text = GOOD + "hooks = ['ToyHook', dict(type='ToyHook', every=2)]\n"
    uses = check_config(load_config(write("c.py", text))).uses
    assert [u.key for u in uses if u.found.registry == "hooks"] == ["hooks.0", "hooks.1"]
    text = findings(GOOD + "hooks = ['ToyHok', dict(type='ToyHook', evry=2)]\n", write)
    assert "hooks.0: no fluxvla.hooks plugin named 'ToyHok'; did you mean 'ToyHook'?" in text
    assert "hooks.1.evry: ToyHook takes no 'evry'; did you mean 'every'?" in text


def test_datasets_by_name(write: Write) -> None:
    text = GOOD.replace(
        "dataset=dict(type='ToyDataset', data_root_path='d',",
        "dataset=dict(a=[dict(type='ToyDataset')], b=dict(type='ToyDataset', data_root_path='d')),"
        "\n    other=dict(",
    )
    assert "train_dataloader.dataset.a.0: ToyDataset needs 'data_root_path'" in findings(
        text, write
    )


def test_two_distributions_with_one_name(write: Write, install: Install) -> None:
    points = "[fluxvla.operators]\nToyOperator = toy.robot:ToyOperator\n"
    install("acme-toy", entry_points=points)
    text = findings(GOOD, write)
    assert "'ToyOperator' is provided by acme-toy 1.0 (toy.robot:ToyOperator), fluxvla-toy" in text
    assert "write type='acme-toy:ToyOperator' or type='fluxvla-toy:ToyOperator' to choose" in text
    text = GOOD.replace("'ToyOperator'", "'acme-toy:ToyOperator'")
    checked = check_config(load_config(write("c.py", text)))
    assert checked.uses[-1].found.origin == "acme-toy 1.0"
    text = findings(GOOD + "robot = dict(type='other-toy:ToyOperator')\n", write)
    assert "no plugin named 'other-toy:ToyOperator'" in text


def test_one_name_in_two_registries(write: Write, install: Install) -> None:
    install("acme-toy", entry_points="[fluxvla.metrics]\nToyOperator = toy.robot:ToyOperator\n")
    assert check_config(load_config(write("c.py", GOOD))).sections
    text = findings(GOOD + "robot = dict(type='ToyOperator')\n", write)
    assert (
        "robot.type: 'ToyOperator' is in fluxvla.operators, fluxvla.metrics, and the key does "
        "not say which"
    ) in text
    text = GOOD + "robot = dict(type='fluxvla-toy:ToyOperator')\n"
    assert examine(load_config(write("c.py", text))).problems == ()


def test_plugins_that_cannot_work(write: Write, install: Install) -> None:
    points = (
        "[fluxvla.operators]\nStale = gone_module:X\nOld = toy_old:Old\nTypo = toy_old:Nothing\n"
    )
    install("acme-toy", entry_points=points, files={"toy_old.py": "class Old:\n    api = '9.0'\n"})
    points = "[fluxvla.operators]\nPicky = toy_old:Old\n"
    install("picky-toy", entry_points=points, requires=("fluxvla-core>=99",))
    text = findings(
        "a = dict(type='Stale')\nb = dict(type='Old')\nc = dict(type='Picky')\n"
        "d = dict(type='Typo')\n",
        write,
    )
    assert (
        "a.type: acme-toy 1.0 provides 'Stale' but its module 'gone_module' is missing "
        "(a stale or orphaned install): reinstall acme-toy"
    ) in text
    assert (
        "b.type: acme-toy 1.0: Old is written for operators 9.0, this core speaks 1.0: "
        "pip install --upgrade fluxvla-core"
    ) in text
    assert "c.type: picky-toy 1.0 needs fluxvla-core>=99, but " in text
    assert (
        "d.type: acme-toy 1.0: entry point Typo = 'toy_old:Nothing' names an object that does "
        "not exist"
    ) in text


class HereRunner:
    def __init__(self, operator: Any, speed: int = 1, **kwargs: Any) -> None:
        self.kwargs = kwargs

    def run_setup(self) -> None: ...
    def run(self) -> None: ...


@pytest.fixture
def here() -> Iterator[None]:
    RUNNERS.register_module()(HereRunner)

    @OPERATORS.register_module("HereOperator")
    class Local:
        def __init__(self, port: int) -> None: ...
        def get_frame(self) -> None: ...

    yield
    RUNNERS.unregister("HereRunner")
    OPERATORS.unregister("HereOperator")


def test_classes_of_this_process_are_checked_too(write: Write, here: None) -> None:
    text = findings(
        "eval = dict(type='HereRunner', anything=1, operator=dict(type='HereOperator', prt=1))\n",
        write,
    )
    assert "HereOperator" not in text.partition("takes no 'prt'")[2]
    assert "eval.operator: Local needs 'port'" in text
    assert "eval.operator.prt: Local takes no 'prt'; did you mean 'port'?" in text
    assert "anything" not in text
    config = load_config(
        write("d.py", "eval = dict(type='HereRunner', operator=dict(type='HereOperator', port=1))")
    )
    assert {u.found.origin for u in check_config(config).uses} == {"registered in this process"}
