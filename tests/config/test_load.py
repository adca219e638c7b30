"""Reading .py, .toml and .json configs; every message about one that cannot be read."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from fluxvla_core.config.load import load_config, write_resolved
from fluxvla_core.errors import ConfigError

from .conftest import Write


def message(path: Path | str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert caught.value.exit_code == 2
    return str(caught.value)


def test_a_py_config_gives_its_plain_public_data(write: Write) -> None:
    path = write(
        "c.py",
        """\
        import os
        from pathlib import Path
        root = Path('/data')
        _hidden = 1
        def helper(): return 3
        cameras = ('front', 'wrist')
        runner = dict(type='R', max_epochs=helper(), keys=cameras, where=root / 'x', off=None)
        """,
    )
    config = load_config(path)
    assert config.tree == {
        "cameras": ["front", "wrist"],
        "runner": {
            "type": "R",
            "max_epochs": 3,
            "keys": ["front", "wrist"],
            "where": "/data/x",
            "off": None,
        },
    }
    assert config.file == "c.py"
    assert config.where("runner.max_epochs") == "c.py:7"
    assert config.where("runner.keys.1") == "c.py:6"
    assert config.where("nowhere") == "c.py"


def test_a_toml_config_gives_the_same_tree(write: Write) -> None:
    path = write(
        "c.toml",
        """\
        cameras = ["front", "wrist"]
        [runner]
        type = "R"
        max_epochs = 3
        """,
    )
    config = load_config(path)
    assert config.tree == {
        "cameras": ["front", "wrist"],
        "runner": {"type": "R", "max_epochs": 3},
    }
    assert config.where("runner.max_epochs") == "c.toml:4"


def test_two_keys_never_share_one_object(write: Write) -> None:
    path = write("c.py", "t = dict(a=1)\nrunner = dict(x=t)\neval = dict(x=t)\n")
    tree = load_config(path).tree
    tree["runner"]["x"]["a"] = 2
    assert tree["eval"]["x"]["a"] == 1


# -- inheritance -----------------------------------------------------------------------------


def test_bases_of_both_syntaxes_merge_and_keep_their_own_places(write: Write) -> None:
    write("base/a.toml", "[runner]\ntype = 'R'\nlearning_rate = 0.1\nkeys = [1, 2]\n")
    write("base/b.py", "eval = dict(type='E', seed=7)\n")
    path = write(
        "c.py",
        """\
        _base_ = ['base/a.toml', 'base/b.py']
        runner = dict(learning_rate=0.2, keys=[3])
        """,
    )
    config = load_config(path)
    assert config.tree == {
        "runner": {"type": "R", "learning_rate": 0.2, "keys": [3]},
        "eval": {"type": "E", "seed": 7},
    }
    assert config.where("runner.type") == "base/a.toml:2"
    assert config.where("runner.learning_rate") == "c.py:2"
    assert config.where("runner.keys.0") == "c.py:2"
    assert config.where("eval.seed") == "base/b.py:1"


def test_a_toml_config_inherits_a_py_one(write: Write) -> None:
    write("a.py", "runner = dict(type='R', n=1)\n")
    path = write("c.toml", "_base_ = 'a.py'\n[runner]\nn = 2\n")
    config = load_config(path)
    assert config.tree == {"runner": {"type": "R", "n": 2}}
    assert config.where("runner.type") == "a.py:1"


def test_a_base_inside_an_installed_package_is_found_without_importing_it(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "site" / "fluxvla_toy"
    (package / "configs").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('imported')")
    (package / "configs" / "arm.toml").write_text("[runner]\ntype = 'R'\n")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    path = write("c.py", "_base_ = 'fluxvla_toy:configs/arm.toml'\n")
    assert load_config(path).tree == {"runner": {"type": "R"}}

    path = write("d.py", "_base_ = 'fluxvla_toy:configs/leg.toml'\n")
    assert "d.py:1: _base_ names 'fluxvla_toy:configs/leg.toml', but fluxvla_toy has no" in message(
        path
    )
    path = write("e.py", "_base_ = 'fluxvla_nobody:x.toml'\n")
    assert "no package 'fluxvla_nobody' is installed" in message(path)


def test_delete_replaces_a_table_and_never_stays(write: Write) -> None:
    write("a.py", "runner = dict(op=dict(type='A', x=1), gone=dict(y=1), lone=dict(z=1))\n")
    path = write(
        "c.py",
        """\
        _base_ = 'a.py'
        runner = dict(
            op=dict(_delete_=True, type='B'),
            gone=dict(_delete_=True),
            lone=dict(_delete_=False, w=2),
            fresh=[dict(_delete_=True, v=3)],
        )
        """,
    )
    assert load_config(path).tree == {
        "runner": {"op": {"type": "B"}, "lone": {"z": 1, "w": 2}, "fresh": [{"v": 3}]}
    }
    path = write("d.py", "runner = dict(op=dict(_delete_=True, a=1))\n")
    assert load_config(path).tree == {"runner": {"op": {"a": 1}}}


def test_none_switches_a_table_off_and_on(write: Write) -> None:
    write("a.py", "runner = dict(tokenizer=dict(type='T'), sampler=None)\n")
    path = write("c.py", "_base_ = 'a.py'\nrunner = dict(tokenizer=None, sampler=dict(type='S'))\n")
    assert load_config(path).tree["runner"] == {"tokenizer": None, "sampler": {"type": "S"}}


def test_a_table_and_a_value_do_not_replace_each_other(write: Write) -> None:
    write("a.py", "runner = dict(lr=0.1,\n  op=dict(type='A'),\n  mark=dict())\n")
    path = write(
        "c.py", "_base_ = 'a.py'\nrunner = dict(lr=dict(a=1), op=[1], mark=dict(_delete_=3))\n"
    )
    text = message(path)
    assert text.startswith("3 problems in the config:")
    assert (
        "c.py:2: runner.lr: a table cannot replace the single value inherited from a.py:1; "
        "if you mean it, write _delete_=True in the table"
    ) in text
    assert (
        "c.py:2: runner.op: a list cannot replace the table inherited from a.py:2; "
        "write a table, or None to switch it off"
    ) in text
    assert "runner.mark: _delete_ must be True or False, got 3" in text


def test_two_bases_must_not_define_one_key(write: Write) -> None:
    write("a.py", "runner = dict(lr=1, keys=[dict(x=1)])\n")
    write("b.toml", "[runner]\nlr = 1\nkeys = []\n")
    text = message(write("c.py", "_base_ = ['a.py', 'b.toml']\n"))
    assert "b.toml:2: runner.lr: another base defines it too, at a.py:1" in text
    assert "b.toml:3: runner.keys: another base defines it too, at a.py:1" in text
    assert "let one inherit the other" in text


def test_two_bases_may_share_a_base(write: Write) -> None:
    write("root.py", "model = dict(type='M')\n")
    write("a.py", "_base_ = 'root.py'\nrunner = dict(type='R')\n")
    write("b.py", "_base_ = 'root.py'\neval = dict(type='E')\n")
    tree = load_config(write("c.py", "_base_ = ['a.py', 'b.py']\n")).tree
    assert sorted(tree) == ["eval", "model", "runner"]


def test_a_circle_is_named(write: Write) -> None:
    write("a.py", "_base_ = 'b.toml'\n")
    write("b.toml", "_base_ = 'a.py'\n")
    assert "circular _base_: a.py -> b.toml -> a.py" in message("a.py")


def test_a_base_that_is_not_there_or_no_name(write: Write) -> None:
    assert "c.py:1: _base_ names 'gone.py', which is not there" in message(
        write("c.py", "_base_ = 'gone.py'\n")
    )
    assert "d.py:1: _base_ must be a file name or a list of them, got 3" in message(
        write("d.py", "_base_ = 3\n")
    )
    assert load_config(write("e.py", "_base_ = []\nx = 1\n")).tree == {"x": 1}


# -- bad input -------------------------------------------------------------------------------


def test_a_config_that_is_not_there_suggests_its_neighbours(write: Write) -> None:
    write("configs/aloha_sim_transfer.py", "")
    write("configs/readme.md", "")
    assert message("configs/aloha_sim_transfr.py") == (
        "configs/aloha_sim_transfr.py: no such config; did you mean configs/aloha_sim_transfer.py?"
    )
    text = message("configs/zzz.toml")
    assert text == (
        "configs/zzz.toml: no such config\n  next: configs there: aloha_sim_transfer.py"
    )
    assert message("confgs/x.py") == "confgs/x.py: no such config: there is no folder confgs"


def test_a_directory(write: Write) -> None:
    write("configs/a.py", "")
    assert message("configs") == (
        "configs: this is a directory, not a config file\n"
        "  next: name one of the configs in it: a.py"
    )
    (Path("empty")).mkdir()
    assert message("empty") == "empty: this is a directory, not a config file"


@pytest.mark.parametrize("name", ["c.yaml", "c"])
def test_another_kind_of_file(write: Write, name: str) -> None:
    assert "a config is a .py, .toml or .json file, not" in message(write(name, "a: 1\n"))


def test_not_utf8(write: Write) -> None:
    path = write("c.toml", "")
    path.write_bytes(b"a = '\xff'\n")
    assert message(path) == "c.toml: not a text file in UTF-8 (byte 5)"


def test_a_file_that_may_not_be_read(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write("c.toml", "")

    def refuse(*args: object, **kwargs: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)
    assert message(path) == "c.toml: cannot be read: Permission denied"


def test_syntax_errors_have_their_line(write: Write) -> None:
    assert message(write("c.py", "a = 1\nrunner = dict(\n  type='R'\n  lr=1)\n")).startswith(
        "c.py:3: syntax error: "
    )
    text = message(write("c.toml", "a = 1\nb = = 2\n"))
    assert text.startswith("c.toml:2: syntax error: Invalid value (column 5) in 'b = = 2'")
    assert message(write("c.json", '{"format": \n nope}')).startswith("c.json:2: syntax error: ")
    path = write("d.py", "a = 1\0\n")
    assert message(path).startswith("d.py")


def test_an_exception_in_a_config_has_the_line_of_the_config(write: Write) -> None:
    path = write("c.py", "import json\nx = 1\ny = json.loads('nope')\n")
    assert message(path).startswith("c.py:3: the config raised JSONDecodeError: Expecting value")
    path = write("d.py", "def f():\n  return 1 / 0\nx = f()\n")
    assert message(path) == "d.py:2: the config raised ZeroDivisionError: division by zero"
    path = write("e.py", "raise SystemExit(3)\n")
    assert message(path) == "e.py:1: the config raised SystemExit: 3"


def test_values_that_are_no_data(write: Write) -> None:
    path = write(
        "c.py",
        """\
        class Mine: pass
        runner = dict(
            type=Mine,
            tags={1, 2},
            tasks={1: 'lift'},
        )
        """,
    )
    text = message(path)
    assert "c.py:3: runner.type: type must be a string: write type='Mine'" in text
    assert "c.py:4: runner.tags: a config holds plain data" in text
    assert "not a builtins.set" in text
    assert "c.py:5: runner.tasks: a key must be a string: write '1', not 1" in text


def test_a_date_in_toml_is_no_data(write: Write) -> None:
    text = message(write("c.toml", "[runner]\nday = 2026-01-02\n"))
    assert "c.toml:2: runner.day: a config holds plain data" in text


def test_a_py_in_a_checkpoint_is_not_executed(write: Write) -> None:
    write("step-1/manifest.json", "{}")
    path = write("step-1/config.py", "raise SystemExit('executed')\n")
    text = message(path)
    assert "a .py that lies in a checkpoint is not executed" in text
    assert "step-1/config.resolved.json" in text


# -- the resolved config ---------------------------------------------------------------------


def test_a_resolved_config_comes_back_key_for_key(write: Write, tmp_path: Path) -> None:
    path = write("c.py", "runner = dict(type='R', keys=('a', 'b'),\n  lr=5e-5, off=None)\n")
    config = load_config(path)
    saved = tmp_path / "config.resolved.json"
    write_resolved(saved, config)
    again = load_config(saved)
    assert again.tree == config.tree
    assert again.where("runner.lr") == "c.py:2"
    assert json.loads(saved.read_text())["format"] == "fluxvla-config-1"


def test_another_json_is_refused(write: Write) -> None:
    text = message(write("c.json", '{"model": 1}'))
    assert "c.json: a .json config is the config.resolved.json of a run" in text
    assert "this has format None" in text
    text = message(write("d.json", '{"format": "fluxvla-config-1", "config": 3}'))
    assert "'config' and 'origins' must be tables" in text
    text = message(
        write(
            "e.json",
            '{"format": "fluxvla-config-1", "config": {"a": 1}, "origins": {"a": 3}}',
        )
    )
    assert "e.json: a: an origin must be 'file:line', got 3" in text
    assert "this has format None" in message(write("f.json", "[1]"))


def processor_s(work: Callable[[], object]) -> float:
    """Seconds of this process that the quickest of three takes, whatever else the machine does."""
    found = []
    for _ in range(3):
        begin = time.process_time()
        work()
        found.append(time.process_time() - begin)
    return min(found)


def test_keys_by_the_hundred_thousand_are_refused_at_once(write: Write) -> None:
    def keys(count: int) -> Path:
        return write(f"c{count}.toml", "".join(f"a{i}=1\n" for i in range(count)))

    allowed, too_many, too_large = keys(4_000), keys(90_000), keys(400_000)
    assert "more than 1 MiB" in message(too_large)
    assert "90000 keys; 5000 are the most" in message(too_many)
    usual = processor_s(lambda: load_config(allowed))
    assert processor_s(lambda: message(too_large)) < usual
    assert processor_s(lambda: message(too_many)) < 2 * usual * 90_000 / 4_000


def test_places_of_many_keys_are_found_in_linear_time(write: Write) -> None:
    def seconds(size: int) -> float:
        lines = [f"a{i} = 'x'\n" for i in range(8 * size)]
        path = write(f"c{size}.toml", "\n" * (1000 * size) + "".join(lines))
        place = f"c{size}.toml:{1008 * size}"
        assert str(load_config(path).where(f"a{8 * size - 1}")).endswith(place)
        return processor_s(lambda: load_config(path))

    assert seconds(500) < 15 * seconds(100), "25 times as long is quadratic"


@pytest.mark.parametrize("twice", [True, False])
def test_a_base_that_is_named_again_and_again_is_read_once(write: Write, twice: bool) -> None:
    for i in range(25):
        text = f"_base_ = [{', '.join([repr(f'c{i - 1}.toml')] * (2 if twice else 1))}]\n" * (i > 0)
        path = write(f"c{i}.toml", f"{text}k{i} = {i}\n")
    assert load_config(path).tree == {f"k{i}": i for i in range(25)}


def test_chains_of_bases_have_an_end(write: Write) -> None:
    for i in range(60):
        path = write(f"c{i}.toml", f"_base_ = 'c{i - 1}.toml'\n" * (i > 0))
    assert "a chain of more than 50 files by _base_" in message(path)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("c.toml", f"a = {'[' * 450}{']' * 450}"),
        ("c.toml", f"a = {'[' * 50_000}{']' * 50_000}"),
        ("c.toml", f"{'a.' * 500}a = 1"),
        ("c.json", f'{{"format": "fluxvla-config-1", "config": {{"a": {"[" * 450}{"]" * 450}}}}}'),
        ("c.json", "[" * 100_000),
        ("c.py", f"a = {'[' * 150}{']' * 150}"),
        ("c.py", f"a = {'-' * 100_000}1"),
    ],
)
def test_what_is_nested_too_deeply_is_refused(write: Write, name: str, text: str) -> None:
    assert "nested deeper than 100" in message(write(name, text))


@pytest.mark.parametrize(
    ("name", "text", "fact"),
    [
        ("c.toml", f"a = {'9' * 5000}", "a value cannot be read"),
        ("c.json", f'{{"a": {"9" * 5000}}}', "a value cannot be read"),
        (
            "c.json",
            '{"format": "fluxvla-config-1", "config": {"a": "\\ud800", "\\udfff": 1}}',
            "half of a surrogate pair",
        ),
        ("c.py", "a = dict(b='\\ud800')", "half of a surrogate pair"),
    ],
)
def test_values_that_cannot_be_kept_are_refused(
    write: Write, name: str, text: str, fact: str
) -> None:
    assert fact in message(write(name, text))


def test_files_that_are_none_are_refused_at_once(tmp_path: Path) -> None:
    pipe, endless, loop = (tmp_path / f"{name}.toml" for name in ("pipe", "endless", "loop"))
    os.mkfifo(pipe)
    endless.symlink_to("/dev/zero")
    loop.symlink_to(loop)
    assert "is not a regular file" in message(pipe)
    assert "is not a regular file" in message(endless)
    assert "no such config" in message(loop)
