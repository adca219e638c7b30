"""The JSON Schema of configs, read by a validator that knows nothing of FluxVLA."""

from __future__ import annotations

import copy
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import tomli
from jsonschema import Draft202012Validator

from fluxvla_core import OPERATORS
from fluxvla_core.config import source
from fluxvla_core.config.check import examine
from fluxvla_core.config.load import load_config
from fluxvla_core.config.schema import config_schema
from fluxvla_core.config.tree import Config
from tests.conftest import Install

ROOT = Path(__file__).parents[2]
CONFIGS = sorted((ROOT / "configs").glob("*.py"))
Tree = dict[str, Any]


def schema() -> Tree:
    """Of what is installed now, as a file of it is read."""
    source.parse.cache_clear()
    found: Tree = json.loads(json.dumps(config_schema(), allow_nan=False))
    return found


@pytest.fixture(scope="module")
def installed() -> Draft202012Validator:
    made = schema()
    Draft202012Validator.check_schema(made)  # takes a second, so of the others only what is new
    return Draft202012Validator(made)


def found(validator: Draft202012Validator, tree: Tree) -> list[str]:
    """``key: message`` of every error."""
    errors = sorted(validator.iter_errors(tree), key=lambda error: list(map(str, error.path)))
    return [f"{'.'.join(map(str, error.path))}: {error.message}" for error in errors]


@pytest.mark.parametrize("file", CONFIGS, ids=lambda path: path.name)
def test_the_configs_of_this_repository_hold(installed: Draft202012Validator, file: Path) -> None:
    assert found(installed, load_config(file).tree) == []


def without(*path: str | int) -> Callable[[Tree], None]:
    def change(tree: Any) -> None:
        for part in path[:-1]:
            tree = tree[part]
        del tree[path[-1]]

    return change


def put(value: Any, *path: str | int) -> Callable[[Tree], None]:
    def change(tree: Any) -> None:
        for part in path[:-1]:
            tree = tree[part]
        tree[path[-1]] = value

    return change


DATASET = ("train_dataloader", "dataset")
TRANSFORM = (*DATASET, "transforms", 0)
EXTRA = "Additional properties are not allowed"
BATCH = "train_dataloader.per_device_batch_size: 'a' is not of type 'integer'"
OPERATOR = ("inference", "operator")


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (put(1, "runner", "max_step"), f"runner: {EXTRA} ('max_step' was unexpected)"),
        (put(1, "runner", "context"), f"runner: {EXTRA} ('context' was unexpected)"),
        (put("FSDPRunner", "runner", "type"), "runner.type: 'FSDPRunner' is not valid under any"),
        (put("DDPTrainRunner", *OPERATOR, "type"), "inference.operator.type: 'DDPTrainRunner' is"),
        (put("3", "runner", "max_steps"), "runner.max_steps: '3' is not of type 'integer', 'null'"),
        (without("runner", "learning_rate"), "runner: 'learning_rate' is a required property"),
        (without("model", "type"), "model: 'type' is a required property"),
        (without(*OPERATOR, "type"), "inference.operator: 'type' is a required property"),
        (put({"rnk": 2}, "runner", "lora"), f"runner.lora: {EXTRA} ('rnk' was unexpected)"),
        (put(2, *TRANSFORM, "hight"), f"train_dataloader.dataset.transforms.0: {EXTRA}"),
        (put(2, *TRANSFORM), "train_dataloader.dataset.transforms.0: 2 is not of type 'object'"),
        (put([4], *DATASET, "img_keys"), "train_dataloader.dataset.img_keys.0: 4 is not of type"),
        (put(["Nope"], "hooks"), "hooks.0: 'Nope'"),
        (put("a", "train_dataloader", "per_device_batch_size"), BATCH),
        (put({"type": "DDPTrainRunner", "x": 1}, "mine"), f"mine: {EXTRA} ('x' was unexpected)"),
    ],
)
def test_what_is_wrong_with_a_config_is_found(
    installed: Draft202012Validator, change: Callable[[Tree], None], error: str
) -> None:
    tree = copy.deepcopy(load_config(ROOT / "configs" / "ur5e_sim_ros2.py").tree)
    change(tree)
    first, *others = found(installed, tree)
    assert first.startswith(error)
    assert others == []
    problems = examine(Config(tree)).problems
    assert problems or "is not of type" in error  # types of values are the constructors' to judge


def test_a_file_that_inherits_need_not_say_everything_again(
    installed: Draft202012Validator,
) -> None:
    text = """
    _base_ = "configs/aloha_sim_transfer.py"
    [runner]
    max_steps = 20
    [inference.operator]
    type = "URSimOperator"
    hieght = 3
    """
    tree = tomli.loads(text)
    assert found(installed, tree) == [f"inference.operator: {EXTRA} ('hieght' was unexpected)"]
    del tree["inference"]
    assert found(installed, tree) == []
    del tree["_base_"]
    assert found(installed, tree) == ["runner: 'type' is a required property"]


def test_a_variable_may_be_half_a_table(installed: Draft202012Validator) -> None:
    wrong = {"mine": {"operator": {"type": "URSimOperator", "hieght": 3}}}
    assert found(installed, wrong) == [f"mine.operator: {EXTRA} ('hieght' was unexpected)"]
    tree = {"small": {"type": "ResizeImages", "height": 8}, "sizes": [1, 2], "name": "x"}
    assert found(installed, tree) == []


ARM = '''
raise RuntimeError("a schema must not import")
from dataclasses import dataclass
from typing import Annotated, Literal, Optional
@dataclass
class Gains:
    """Gains of the controller.

    Args:
        p: proportional, in 1/s.
    """
    p: float = 1.0
    d: float = 0.0
class AcmeArm:
    """Moves things.

    Args:
        port: where it listens.
    """
    def __init__(
        self, port: str, rate: int = 30, scale: float = 0.5,
        mode: Literal["fast", "slow"] = "fast", limits: tuple[float, float] = (-1.0, 1.0),
        names: "list[str] | None" = None, tags: dict[str, int] = {}, home: Optional[float] = None,
        gains: Gains | None = None, bounded: Annotated[int, "positive"] = 1, other: Odd = ODD,
        many: tuple[int, ...] = (), huge: float = 1e999, context=None,
    ): ...
    def get_frame(self): ...
'''
POINTS = "[fluxvla.operators]\nAcmeArm = acme_schema:AcmeArm\nGone = acme_gone:Gone\n"


@pytest.fixture
def arm(install: Install) -> Iterator[Tree]:
    """The definition of the operator above, and of what it takes."""
    install("acme-schema", entry_points=POINTS, files={"acme_schema.py": ARM})
    yield schema()["$defs"]
    source.parse.cache_clear()


def test_types_defaults_and_descriptions_come_from_the_source(arm: Tree) -> None:
    Draft202012Validator.check_schema(
        {"$defs": {name: made for name, made in arm.items() if "AcmeArm" in name}}
    )
    table = arm["whole:operators:AcmeArm"]
    assert (table["title"], table["description"]) == ("AcmeArm", "Moves things. (acme-schema 1.0)")
    assert table["required"] == ["type", "port"]
    assert table["additionalProperties"] is False
    keys = table["properties"]
    gains = keys.pop("gains")
    assert gains["type"] == ["object", "null"]
    assert gains["properties"]["p"] == {
        "type": "number",
        "default": 1.0,
        "description": "proportional, in 1/s.",
    }
    assert keys == {
        "type": True,
        "_delete_": {"type": "boolean"},
        "port": {"type": "string", "description": "where it listens."},
        "rate": {"type": "integer", "default": 30},
        "scale": {"type": "number", "default": 0.5},
        "mode": {"enum": ["fast", "slow"], "default": "fast"},
        "limits": {
            "type": "array",
            "prefixItems": [{"type": "number"}, {"type": "number"}],
            "minItems": 2,
            "maxItems": 2,
            "default": [-1.0, 1.0],
        },
        "names": {
            "anyOf": [{"type": "null"}, {"type": "array", "items": {"type": "string"}}],
            "default": None,
        },
        "tags": {"type": "object", "additionalProperties": {"type": "integer"}, "default": {}},
        "home": {"type": ["null", "number"], "default": None},
        "bounded": {"type": "integer", "default": 1},
        "other": {"description": "Default: ODD"},
        "many": {"type": "array", "items": {"type": "integer"}, "default": []},
        "huge": {"type": "number", "description": "Default: 1e309"},
    }


def test_what_cannot_work_is_not_offered(arm: Tree) -> None:
    names = arm["whole:operators"]["properties"]["type"]["anyOf"][0]["enum"]
    assert "AcmeArm" in names
    assert "Gone" not in names


def test_names_of_two_and_names_of_the_core(install: Install) -> None:
    files = {"acme_schema.py": ARM}
    install("acme-schema", entry_points=POINTS, files=files)
    points = "[fluxvla.transforms]\nResizeImages = acme_schema:AcmeArm\n"
    install("acme-two", entry_points=POINTS + points)
    checks = Draft202012Validator(schema())
    resize = {"type": "ResizeImages", "height": 8, "width": 8}
    assert found(checks, {"transforms": [resize]}) == []
    theirs = {"type": "acme-two:ResizeImages", "port": 3}
    assert found(checks, {"transforms": [theirs]}) == [
        "transforms.0.port: 3 is not of type 'string'"
    ]
    assert found(checks, {"operator": {"type": "acme-two:AcmeArm", "port": "a"}}) == []
    (error,) = found(checks, {"operator": {"type": "AcmeArm", "port": "a"}})
    assert error.startswith("operator.type: 'AcmeArm' is not valid")
    source.parse.cache_clear()


def test_what_this_process_registered_is_offered() -> None:
    class Nearby:
        def __init__(self, port: int, **others): ...
        def get_frame(self): ...

    OPERATORS.register_module()(Nearby)
    try:
        checks = Draft202012Validator(schema())
    finally:
        OPERATORS.unregister("Nearby")
    assert found(checks, {"operator": {"type": "Nearby", "port": 1, "more": 2}}) == []
    assert found(checks, {"operator": {"type": "Nearby", "port": "1"}}) == [
        "operator.port: '1' is not of type 'integer'"
    ]


def test_nothing_heavy_is_imported() -> None:
    code = "from fluxvla_core.cli.main import main\nassert main(['config', 'schema']) == 0\n"
    code += "import sys; print(*({'torch', 'numpy', 'cv2', 'pyarrow'} & {*sys.modules}), 'end')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "end"
