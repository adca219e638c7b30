"""Where keys are written: the two scanners against files in every shape that configs take."""

from __future__ import annotations

import ast
import textwrap

import pytest
import tomli
from hypothesis import given, settings
from hypothesis import strategies as st

from fluxvla_core.config.positions import py_positions, toml_positions
from fluxvla_core.config.tree import all_keys, join_key, leaves, parent_key, split_key


def lines(positions: dict[str, str]) -> dict[str, int]:
    return {key: int(place.rpartition(":")[2]) for key, place in positions.items()}


def py(text: str) -> dict[str, int]:
    return lines(py_positions(ast.parse(textwrap.dedent(text)), "c.py"))


def toml(text: str) -> dict[str, int]:
    return lines(toml_positions(textwrap.dedent(text), "c.toml"))


def test_nested_calls_dicts_and_lists() -> None:
    found = py(
        """\
        model = dict(
            type='M',
            head={'type': 'H',
                  'sizes': [1,
                            2]},
        )
        """
    )
    assert found == {
        "model": 1,
        "model.type": 2,
        "model.head": 3,
        "model.head.type": 3,
        "model.head.sizes": 4,
        "model.head.sizes.0": 4,
        "model.head.sizes.1": 5,
    }


def test_variables_copies_and_updates_are_followed() -> None:
    found = py(
        """\
        import copy
        base = dict(a=1,
                    b=2)
        one = dict(base, b=3)
        two = dict(**base,
                   c=4)
        three = base.copy()
        three['b'] = 5
        four = copy.deepcopy(base)
        five = base | dict(b=6)
        six = dict(x=base)
        seven = [base] + [1]
        """
    )
    assert (found["one.a"], found["one.b"]) == (2, 4)
    assert (found["two.a"], found["two.c"]) == (2, 6)
    assert (found["three.a"], found["three.b"]) == (2, 8)
    assert found["four.b"] == 3
    assert (found["five.a"], found["five.b"]) == (2, 10)
    assert (found["six.x"], found["six.x.b"]) == (11, 3)
    assert found["seven.0.a"] == 2


def test_branches_annotations_and_additions() -> None:
    found = py(
        """\
        if True:
            a: dict = dict(x=1)
        else:
            b = 2
        for i in range(2):
            c = 3
        try:
            d = 4
        except ValueError:
            e = 5
        keys = ['a']
        keys += ['b']
        first, *rest = 1, 2
        values = [*rest, dict(x=1)]
        made = list(range(3))
        """
    )
    assert {k: found[k] for k in ("a.x", "b", "c", "d", "e")} == {
        "a.x": 2,
        "b": 4,
        "c": 6,
        "d": 8,
        "e": 10,
    }
    assert found["keys"] == 12
    assert "values.1" not in found
    assert found["made"] == 15


def test_a_replaced_value_forgets_its_old_keys() -> None:
    assert py("a = dict(x=1)\na = dict(y=2)\n") == {"a": 2, "a.y": 2}


def test_toml_tables_arrays_and_inline_tables() -> None:
    found = toml(
        '''\
        # comment with = and [brackets]
        title = "a # b = [c]"
        [model]
        type = 'M'
        head = { type = "H", sizes = [1, 2] }
        text = """
        [not.a.table]
        x = 1
        """
        sizes = [
          1, # one
          { a = 1 },
        ]
        a.b."c.d" = 1
        [[model.transforms]]
        type = "T"
        [model.transforms.inner]
        x = 1
        [[model.transforms]]
        type = "U"
        raw = \'\'\'
        y = 2
        \'\'\'
        when = 1979-05-27T07:32:00Z
        '''
    )
    assert found["title"] == 2
    assert found["model"] == 3
    assert found["model.head.type"] == found["model.head.sizes.1"] == 5
    assert found["model.text"] == 6
    assert (found["model.sizes.0"], found["model.sizes.1.a"]) == (11, 12)
    assert found[r"model.a.b.c\.d"] == 14
    assert found["model.transforms"] == 15
    assert found["model.transforms.0.inner.x"] == 18
    assert found["model.transforms.1.type"] == 20
    assert found["model.transforms.1.when"] == 24
    assert not any("not" in key or key.endswith(".y") for key in found)


_name = st.text("abc-_1", min_size=1, max_size=3) | st.sampled_from(["a.b", 'q"t', "ü"])
_scalar = st.one_of(
    st.booleans(),
    st.integers(-5, 5),
    st.sampled_from([1.5, "x", "a = 1", "[t]", 'say "hi"', "# no", "it's"]),
)
_inline = st.recursive(
    _scalar,
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(_name, inner, max_size=2),
    max_leaves=6,
)


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_quoted(k)} = {_toml(v)}" for k, v in value.items()) + "}"
    return repr(value)


@settings(max_examples=150, deadline=None)
@given(st.dictionaries(_name, st.dictionaries(_name, _inline, max_size=3), max_size=3))
def test_every_key_of_a_toml_file_has_the_line_it_is_on(tree: dict[str, dict[str, object]]) -> None:
    rows: list[str] = []
    expected: dict[str, int] = {}
    for table, pairs in tree.items():
        rows += ["# [comment]", f"[{_quoted(table)}]"]
        expected[join_key("", table)] = len(rows)
        for name, value in pairs.items():
            rows.append(f"{_quoted(name)} = {_toml(value)} # x = 1")
            for key in all_keys(value, join_key(join_key("", table), name)):
                expected[key] = len(rows)
    text = "\n".join(rows)
    assert tomli.loads(text) == tree
    assert lines(toml_positions(text, "c.toml")) == expected


@pytest.mark.parametrize(
    ("key", "parts"),
    [("a", ["a"]), ("a.0.b", ["a", "0", "b"]), (r"a.b\.c", ["a", "b.c"])],
)
def test_dotted_keys_split_and_join(key: str, parts: list[str]) -> None:
    assert split_key(key) == parts
    joined = ""
    for part in parts:
        joined = join_key(joined, part)
    assert joined == key
    assert parent_key(key) == (
        join_key("", parts[0]) if len(parts) == 2 else key[:-2] * (len(parts) > 1)
    )


def test_leaves_are_what_a_person_would_list() -> None:
    tree = {"a": {"b": [1, 2], "c": [{"d": 1}], "e": {}, "f": []}}
    assert list(leaves(tree)) == [
        ("a.b", [1, 2]),
        ("a.c.0.d", 1),
        ("a.e", {}),
        ("a.f", []),
    ]
