"""Source positions (``file:line``) of the keys of a ``.py`` or ``.toml`` config."""

from __future__ import annotations

import ast
import re
from bisect import bisect_left
from collections.abc import Iterable, Iterator

from fluxvla_core.config.tree import join_key

_BLANK = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_SPACE = re.compile(r"[ \t]*")
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_SCALAR = re.compile(r"[^,\]\}\n#]+")
_STRINGS = (
    re.compile(r'"""(?:\\.|[^\\])*?"{3,5}', re.DOTALL),
    re.compile(r"'''.*?'{3,5}", re.DOTALL),
    re.compile(r'"(?:\\.|[^"\\\n])*"'),
    re.compile(r"'[^'\n]*'"),
)


def py_positions(tree: ast.Module, file: str) -> dict[str, str]:
    """Dotted key -> ``file:line`` for what module-level statements assign.

    Follows ``dict(...)`` and ``{...}`` with ``**``, lists and tuples, names assigned before,
    ``name.copy()``, ``copy.deepcopy(name)``, ``a | b``, ``name['key'] = ...``, and the branches of
    ``if``, ``for``, ``with`` and ``try``. What it cannot follow (a function's result, a
    comprehension) takes the place of the nearest key around it.
    """
    walker = _PythonWalker(file)
    for statement in _statements(ast.iter_child_nodes(tree)):
        walker.statement(statement)
    return walker.out


_BRANCHING = (ast.If, ast.For, ast.With, ast.While, ast.Try, ast.ExceptHandler)


def _statements(nodes: Iterable[ast.AST]) -> Iterator[ast.stmt]:
    for node in nodes:
        if isinstance(node, ast.stmt):
            yield node
        if isinstance(node, _BRANCHING):
            yield from _statements(ast.iter_child_nodes(node))


class _PythonWalker:
    def __init__(self, file: str) -> None:
        self.file = file
        self.out: dict[str, str] = {}

    def statement(self, node: ast.stmt) -> None:
        if isinstance(node, ast.Assign):
            for target in node.targets:
                self.assign(target, node.value)
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            self.assign(node.target, node.value)
        elif isinstance(node, ast.AugAssign):
            key = _target(node.target)
            if key:
                self.out[key] = f"{self.file}:{node.lineno}"

    def assign(self, target: ast.expr, value: ast.expr) -> None:
        key = _target(target)
        if key:
            found = self.places(value, key)
            for old in [k for k in self.out if k == key or k.startswith(key + ".")]:
                del self.out[old]
            self.out[key] = f"{self.file}:{target.lineno}"
            self.out.update(found)

    def places(self, node: ast.expr, key: str) -> dict[str, str]:
        """The places of everything below ``key``, if ``node`` is its value."""
        positions: dict[str, str] = {}
        if isinstance(node, ast.Name):
            prefix = node.id + "."
            return {
                key + "." + k[len(prefix) :]: v for k, v in self.out.items() if k.startswith(prefix)
            }
        if isinstance(node, ast.Call):
            return self._call(node, key)
        if isinstance(node, ast.Dict):
            for name, value in zip(node.keys, node.values, strict=True):
                if name is None:
                    positions.update(self.places(value, key))
                elif isinstance(name, ast.Constant) and isinstance(name.value, str):
                    self._put(positions, join_key(key, name.value), name.lineno, value)
        elif isinstance(node, (ast.List, ast.Tuple)):
            for index, item in enumerate(node.elts):
                if isinstance(item, ast.Starred):  # what follows has an unknown index
                    break
                self._put(positions, join_key(key, index), item.lineno, item)
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitOr):
            positions.update(self.places(node.left, key))
            positions.update(self.places(node.right, key))
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
            positions.update(self.places(node.left, key))  # the right side's indices are unknown
        return positions

    def _call(self, node: ast.Call, key: str) -> dict[str, str]:
        found: dict[str, str] = {}
        called = node.func
        if isinstance(called, ast.Name) and called.id == "dict":
            for argument in node.args:
                found.update(self.places(argument, key))
            for word in node.keywords:
                if word.arg is None:
                    found.update(self.places(word.value, key))
                else:
                    self._put(found, join_key(key, word.arg), word.lineno, word.value)
        elif isinstance(called, ast.Attribute) and called.attr == "copy" and not node.args:
            return self.places(called.value, key)
        elif _name(called) in {"deepcopy", "copy"} and len(node.args) == 1:
            return self.places(node.args[0], key)
        return found

    def _put(self, found: dict[str, str], key: str, line: int, value: ast.expr) -> None:
        for old in [k for k in found if k.startswith(key + ".")]:
            del found[old]
        found[key] = f"{self.file}:{line}"
        found.update(self.places(value, key))


def _target(node: ast.expr) -> str | None:
    """``name`` or ``name['a'][0]`` as a dotted key."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant):
        outer = _target(node.value)
        if outer and isinstance(node.slice.value, (str, int)):
            return join_key(outer, node.slice.value)
    return None


def _name(node: ast.expr) -> str:
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) else ""


def toml_positions(text: str, file: str) -> dict[str, str]:
    """Dotted key -> ``file:line``, inline tables and arrays of tables included.

    A recursive-descent walk over text that ``tomli`` has accepted already: it only has to know
    where keys start and where values end (TOML 1.0, https://toml.io/en/v1.0.0).
    """
    return _TomlScanner(text, file).scan()


class _TomlScanner:
    def __init__(self, text: str, file: str) -> None:
        self.text = text
        self.file = file
        self.at = 0
        self.ends = [found.start() for found in re.finditer("\n", text)]
        self.out: dict[str, str] = {}
        self.last: dict[str, int] = {}  # arrays of tables: key -> index of the newest item

    def scan(self) -> dict[str, str]:
        table = ""
        self.skip(_BLANK)
        while self.at < len(self.text):
            if self.text[self.at] == "[":
                table = self.header()
            else:
                self.pair(table)
            self.skip(_BLANK)
        return self.out

    def skip(self, pattern: re.Pattern[str]) -> str:
        match = pattern.match(self.text, self.at)
        if match is None:
            return ""
        self.at = match.end()
        return match[0]

    def mark(self, key: str, start: int) -> None:
        self.out[key] = self.place(start)

    def place(self, start: int) -> str:
        return f"{self.file}:{bisect_left(self.ends, start) + 1}"

    def header(self) -> str:
        start = self.at
        array = self.text.startswith("[[", self.at)
        self.at += 2 if array else 1
        names = self.names()
        self.at += 2 if array else 1
        key = ""
        for position, name in enumerate(names):
            key = join_key(key, name)
            final = position == len(names) - 1
            if array and final:
                self.out.setdefault(key, self.place(start))
                self.last[key] = self.last.get(key, -1) + 1
            if key in self.last:
                key = join_key(key, self.last[key])
        self.mark(key, start)
        return key

    def names(self) -> list[str]:
        """``a . "b c" . d`` with the blanks around it."""
        import tomli

        found: list[str] = []
        while True:
            self.skip(_SPACE)
            quoted = self.string()
            if quoted:
                found.extend(tomli.loads(f"{quoted} = 0"))  # its escapes are TOML's own
            else:
                found.append(self.skip(_BARE))
            self.skip(_SPACE)
            if self.text[self.at : self.at + 1] != ".":
                return found
            self.at += 1

    def pair(self, table: str) -> None:
        start = self.at
        key = table
        for name in self.names():
            key = join_key(key, name)
            self.mark(key, start)
        self.at += 1  # the equals sign
        self.skip(_SPACE)
        self.value(key)

    def value(self, key: str) -> None:
        opening = self.text[self.at]
        if opening == "[":
            self.items(key, "]")
        elif opening == "{":
            self.items(key, "}")
        elif not self.string():
            self.skip(_SCALAR)

    def items(self, key: str, closing: str) -> None:
        self.at += 1
        index = 0
        self.skip(_BLANK)
        while self.text[self.at] != closing:
            if closing == "]":
                inner = join_key(key, index)
                self.mark(inner, self.at)
                self.value(inner)
            else:
                self.pair(key)
            index += 1
            self.skip(_BLANK)
            if self.text[self.at] == ",":
                self.at += 1
                self.skip(_BLANK)
        self.at += 1

    def string(self) -> str:
        for pattern in _STRINGS:
            found = self.skip(pattern)
            if found:
                return found
        return ""
