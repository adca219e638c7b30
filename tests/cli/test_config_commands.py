"""``fluxvla config show`` and ``check``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fluxvla_core import DATASETS, OPERATORS, RUNNERS
from fluxvla_core.cli.config_commands import literal
from fluxvla_core.config.overrides import parse_value

from .conftest import Fluxvla, Write


def test_show_prints_keys_as_overrides_take_them(fluxvla: Fluxvla, write: Write) -> None:
    write("d.toml", "_base_ = 'c.py'\n[eval]\nseeds = 3\nnames = ['a b', 'c']\n")
    ended = fluxvla("config", "show", "d.toml", "--set", "runner.max_epochs=7")
    assert ended.code == 0
    assert ended.out == (
        'train_dataloader.dataset.type = "ToyDataset"\n'
        'runner.type = "ToyTrainRunner"\n'
        "runner.max_epochs = 7\n"
        'eval.type = "ToyEvalRunner"\n'
        'eval.operator.type = "ToyOperator"\n'
        "eval.seeds = 3\n"
        'eval.names = ["a b", "c"]\n'
    )


def test_show_with_origins(fluxvla: Fluxvla, write: Write) -> None:
    write("d.toml", "_base_ = 'c.py'\n[eval]\nseeds = 3\n")
    ended = fluxvla("config", "show", "--origin", "d.toml", "--cfg-options", "runner.max_epochs=7")
    rows = dict(map(str.strip, line.split("  # ")) for line in ended.out.splitlines())
    assert rows["runner.max_epochs = 7"] == "--set runner.max_epochs=7"
    assert rows["eval.seeds = 3"] == "d.toml:3"
    assert rows['eval.type = "ToyEvalRunner"'] == "c.py:4"


def test_show_blames_an_addition_only_for_what_it_added(fluxvla: Fluxvla, write: Write) -> None:
    write("d.toml", "_base_ = 'c.py'\n[eval]\nnames = ['a']\n")
    words = ("--set", "eval.names+=['b', 'c']", "--set", "eval.operator+={port = 2}")
    ended = fluxvla("config", "show", "--origin", "d.toml", *words)
    rows = dict(map(str.strip, line.split("  # ")) for line in ended.out.splitlines())
    assert rows['eval.names = ["a", "b", "c"]'] == "d.toml:3, --set eval.names+=['b', 'c']"
    assert rows['eval.operator.type = "ToyOperator"'] == "c.py:4"
    assert rows["eval.operator.port = 2"] == "--set eval.operator+={port = 2}"


def test_check_says_what_is_used(fluxvla: Fluxvla, write: Write) -> None:
    ended = fluxvla("config", "check", "c.py", "--plugin", "toy.py")
    assert ended.code == 0
    assert ended.out.splitlines() == [
        "c.py: no problems; sections: runner, eval",
        "  train_dataloader.dataset  ToyDataset      registered in this process",
        "  runner                    ToyTrainRunner  registered in this process",
        "  eval                      ToyEvalRunner   registered in this process",
        "  eval.operator             ToyOperator     registered in this process",
    ]


def test_check_fails_with_every_problem(fluxvla: Fluxvla, write: Write) -> None:
    ended = fluxvla(
        "config",
        "check",
        "c.py",
        "--plugin",
        "toy.py",
        "--set",
        "runner.max_epoch+=1",
        "--set",
        "eval.operator.prt+=1",
    )
    assert ended.code == 2
    assert ended.err.startswith("2 problems in the config:\n")
    assert (
        "--set runner.max_epoch+=1: runner.max_epoch: ToyTrainRunner takes no 'max_epoch'"
    ) in ended.err
    assert "eval.operator.prt: ToyOperator takes no 'prt'; did you mean 'port'?" in ended.err


def test_check_for_one_section(fluxvla: Fluxvla, write: Write) -> None:
    write("d.py", "runner = dict(type='FarTrainRunner')\neval = dict(type='ToyEvalRunner')\n")
    words = ("config", "check", "d.py", "--plugin", "toy.py")
    assert fluxvla(*words, "--section", "eval").code == 0


def test_check_without_the_section_fails(fluxvla: Fluxvla, write: Write) -> None:
    write("d.py", "runner = dict(type='FarTrainRunner')\neval = dict(type='ToyEvalRunner')\n")
    ended = fluxvla("config", "check", "d.py", "--plugin", "toy.py")
    assert ended.code == 2
    assert "runner.type: no fluxvla.runners plugin named 'FarTrainRunner'" in ended.err


@pytest.mark.parametrize("command", [("run", "--config"), ("config", "check")])
def test_check_and_run_name_a_section_alike(
    fluxvla: Fluxvla, write: Write, command: tuple[str, ...]
) -> None:
    write("d.py", "eval = dict(type='EvalRunner')\nx = dict(a=1)\n")
    ended = fluxvla(*command, "d.py", "--section", "evl")
    assert (ended.code, ended.out) == (2, "")
    assert ended.err == (
        "d.py: no section 'evl'; did you mean 'eval'?\n  next: sections there: eval (EvalRunner)\n"
    )
    ended = fluxvla(*command, "d.py", "--section", "x")
    assert ended.code == 2
    assert "d.py: section 'x' cannot be run: it is not a table whose type is a runner" in ended.err


def test_a_config_without_sections(fluxvla: Fluxvla, write: Write) -> None:
    write("d.py", "x = 1\n")
    assert fluxvla("config", "check", "d.py").out == "d.py: no problems; sections: none\n"
    write("e.py", "")
    assert fluxvla("config", "show", "e.py").out == ""


@pytest.mark.parametrize(
    "value", [None, True, 3, 1e-5, "a 'b' \"c\"", [1, ["x"]], {"type": "X", "y": [1]}, "ü"]
)
def test_what_is_printed_can_be_typed_again(value: object) -> None:
    assert parse_value(literal(value)) == value


def test_diff_of_files(fluxvla: Fluxvla, write: Write) -> None:
    write("d.toml", "_base_ = 'c.py'\n[runner]\nmax_epochs = 7\n[eval]\nseeds = 3\n")
    ended = fluxvla("config", "diff", "c.py", "d.toml")
    assert (ended.code, ended.out, ended.err) == (
        1,
        "- runner.max_epochs = 1  # c.py:3\n+ runner.max_epochs = 7  # d.toml:3\n"
        "+ eval.seeds = 3         # d.toml:5\n",
        "",
    )
    same = fluxvla("config", "diff", "c.py", "c.py")
    assert (same.code, same.out, same.err) == (0, "", "")
    assert fluxvla("config", "diff", "c.py", "gone.py").code == 2


def test_diff_of_runs(run: Fluxvla, fluxvla: Fluxvla) -> None:
    """A work dir, or what a checkpoint keeps, says where each value was written then."""
    for name, epochs in (("a", 1), ("b", 2)):
        words = ("--section", "runner", "--work-dir", name, "--set", f"runner.max_epochs={epochs}")
        assert run("--config", "c.py", *words).code == 0
    ended = fluxvla("config", "diff", "a", "b/config.resolved.json")
    assert ended.code == 1
    assert ended.out == (
        "- runner.max_epochs = 1  # --set runner.max_epochs=1\n"
        "+ runner.max_epochs = 2  # --set runner.max_epochs=2\n"
    )
    assert fluxvla("config", "diff", "c.py", "a").code == 0
    ended = fluxvla("config", "diff", "c.py", ".")
    assert ended.code == 2
    assert "this is a directory, not a config file" in ended.err


def test_schema(fluxvla: Fluxvla, write: Write) -> None:
    words = ("config", "schema", "--plugin", "toy.py")
    printed = json.loads(fluxvla(*words).out)
    assert printed["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert printed["$defs"]["whole:runners:ToyTrainRunner"]["required"] == ["type", "max_epochs"]
    for registry in (RUNNERS, OPERATORS, DATASETS):
        for name in ("ToyDataset", "ToyOperator", "ToyTrainRunner", "ToyEvalRunner"):
            registry.unregister(name)
    ended = fluxvla(*words, "--out", "s.json")
    assert (ended.code, ended.out) == (0, "wrote s.json\n")
    assert json.loads(Path("s.json").read_text()) == printed
    ended = fluxvla("config", "schema", "--out", "gone/s.json")
    assert (ended.code, ended.err) == (2, "--out gone/s.json: No such file or directory\n")
