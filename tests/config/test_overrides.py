"""``--set``: what values mean, which keys exist, and what is said of those that do not."""

from __future__ import annotations

from typing import Any

import pytest

from fluxvla_core.config.overrides import apply_overrides
from fluxvla_core.config.tree import Config, leaves
from fluxvla_core.errors import ConfigError

TREE: dict[str, Any] = {
    "runner": {"max_epochs": 1, "keys": ["a"], "op": {"type": "A", "x": 1}, "stats.q": 1},
    "transforms": [{"type": "T", "height": 1}, {"type": "U"}],
}
CONFIG = Config(TREE, {"runner.op.x": "c.py:3", "runner.max_epochs": "c.py:1"}, "c.py")


def put(*overrides: str) -> dict[str, Any]:
    return apply_overrides(CONFIG, overrides).tree


def refused(*overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        apply_overrides(CONFIG, overrides)
    return str(caught.value)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3", 3),
        ("1e-4", 1e-4),
        ("true", True),
        ("True", True),
        ("False", False),
        ("None", None),
        ("[1, 'b']", [1, "b"]),
        ('{type = "X", y = 2}', {"type": "X", "y": 2}),
        ('"3"', "3"),
        ("word", "word"),
        ("pick up the onion, then stop", "pick up the onion, then stop"),
        ("two\nx = 3", "two\nx = 3"),
        ("2026-01-02", "2026-01-02"),
        ("none", "none"),
        ("a=b", "a=b"),
        ("", ""),
        ("/data/x.y", "/data/x.y"),
        ("1 2", "1 2"),
    ],
)
def test_values(text: str, value: object) -> None:
    tree = put(f"runner.max_epochs={text}")
    assert tree["runner"]["max_epochs"] == value
    assert type(tree["runner"]["max_epochs"]) is type(value)


def test_blanks_around_the_equals_sign_do_not_matter() -> None:
    assert put("runner.max_epochs = 4")["runner"]["max_epochs"] == 4


def test_nothing_else_changes_and_the_config_itself_never_does() -> None:
    tree = put("transforms.0.height=2", r"runner.stats\.q=5")
    assert tree["transforms"] == [{"type": "T", "height": 2}, {"type": "U"}]
    assert tree["runner"]["stats.q"] == 5
    assert TREE["transforms"][0]["height"] == 1
    assert tree["runner"]["max_epochs"] == 1


def test_a_table_replaces_the_one_that_is_there() -> None:
    tree = put('runner.op={type = "B"}', "transforms.1=3", "transforms=[]")
    assert tree["runner"]["op"] == {"type": "B"}
    assert tree["transforms"] == []


def test_plus_adds_keys_and_appends() -> None:
    tree = put("runner.new+=1", "runner.keys+=b", "runner.keys+=[c, d]".replace("c, d", "'c', 'd'"))
    assert tree["runner"]["new"] == 1
    assert tree["runner"]["keys"] == ["a", "b", "c", "d"]
    assert put("runner.op+={y = 2}")["runner"]["op"] == {"type": "A", "x": 1, "y": 2}
    assert put("transforms.1+={y = 2}")["transforms"][1] == {"type": "U", "y": 2}
    assert put("extra+=1")["extra"] == 1


def test_the_override_becomes_the_place_of_its_key() -> None:
    config = apply_overrides(CONFIG, ["runner.op={type='B', x=2}", "runner.keys+=b"])
    assert config.where("runner.op.x") == "--set runner.op={type='B', x=2}"
    assert config.where("runner.keys.1") == "--set runner.keys+=b"
    assert config.where("runner.max_epochs") == "c.py:1"


def test_what_was_there_before_something_was_added_keeps_its_place() -> None:
    origins = {"runner.op": "c.py:2", "runner.keys": "c.py:4", "transforms.0": "c.py:5"}
    config = Config(TREE, {**CONFIG.origins, **origins}, "c.py")
    more = ["runner.op+={y = 2, type = 'B'}", "runner.keys+=['b', 'c']", "transforms.0+={z = 1}"]
    config = apply_overrides(config, more)
    assert {key: config.where(key) for key, _ in leaves(config.tree)} == {
        "runner.max_epochs": "c.py:1",
        "runner.keys": "c.py:4",
        "runner.op.type": f"--set {more[0]}",
        "runner.op.x": "c.py:3",
        "runner.op.y": f"--set {more[0]}",
        r"runner.stats\.q": "c.py",
        "transforms.0.type": "c.py:5",
        "transforms.0.height": "c.py:5",
        "transforms.0.z": f"--set {more[2]}",
        "transforms.1.type": "c.py",
    }
    places = [config.where(f"runner.keys.{i}") for i in range(3)]
    assert places == ["c.py:4", *[f"--set {more[1]}"] * 2]


def test_a_key_must_exist() -> None:
    assert refused("runner.max_epoch=3") == (
        "1 problem in the config:\n"
        "  --set runner.max_epoch=3: no 'runner.max_epoch' in the config; did you mean "
        "--set runner.max_epochs=3? [to add it: --set runner.max_epoch+=3]"
    )
    assert "no 'runnr.max_epochs' in the config; did you mean --set runner.max_epochs=3?" in (
        refused("runnr.max_epochs=3")
    )
    text = refused("runner.nme={type = 'B'}")
    assert text.endswith("""[to add it: --set 'runner.nme+={type = '"'"'B'"'"'}']""")
    assert refused("zzz.q.w=3").endswith("no 'zzz.q.w' in the config")


def test_all_that_do_not_fit_are_listed() -> None:
    text = refused(
        "runner.max_epochs.x=1",
        "transforms.9.height=1",
        "transforms.first=1",
        "runner.max_epochs+=1",
        "nothing",
        "=3",
        "runner.keys=[1",
        "runner.max_epochs=.5",
        "runner.max_epochs=007",
        "runner.max_epochs.x.y=1",
    )
    assert text.startswith("10 problems in the config:")
    assert "'runner.max_epochs' is a single value, it has no 'x'" in text
    assert "'transforms.9.height': there is no item 9, the list has 2" in text
    assert "'first' must be a number, it counts items of a list from 0" in text
    assert "it is there already, as 1; += adds a key or appends, = replaces" in text
    assert "--set nothing: an override is key=value, or key+=value to add" in text
    assert "'[1' is not a TOML value: " in text
    assert "'.5' is not a TOML number; write it as 0.5, or '\".5\"' for text" in text
    assert "'007' is not a TOML number; write it as 7, or" in text


@pytest.mark.parametrize(
    ("text", "fact"),
    [
        (f"transforms.{'9' * 5000}.height=1", "must be a number"),
        ("transforms.².height=1", "must be a number"),
        (f"runner.max_epochs={'9' * 5000}", "thousands of digits"),
        (f"runner.max_epochs={'[' * 5000}{']' * 5000}", "nested too deeply"),
        ("runner.max_epochs=\udc80", "half of a surrogate pair"),
    ],
)
def test_what_no_config_can_hold_is_refused(text: str, fact: str) -> None:
    assert fact in refused(text)
