"""Where each key of a ``.py`` config is written, read from its syntax tree."""

from __future__ import annotations

import ast
from collections.abc import Iterator

from fluxvla_core.config import keys


def py_positions(tree: ast.Module, file: str) -> dict[str, str]:
    """Dotted key -> ``file:line`` for what module-level statements assign.

    Follows ``dict(...)`` and ``{...}`` with ``**``, lists and tuples, names assigned before,
    ``name.copy()``, ``copy.deepcopy(name)``, ``a | b``, ``name['key'] = ...``, and the branches of
    ``if``, ``for``, ``with`` and ``try``. What it cannot follow (a function's result, a
    comprehension) takes the place of the nearest key around it.
    """
    walker = _Walker(file)
    for statement in _statements(tree.body):
        walker.statement(statement)
    return walker.out


def _statements(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    for node in body:
        yield node
        for name in ("body", "orelse", "handlers", "finalbody"):
            inner = getattr(node, name, None)
            if inner and isinstance(node, (ast.If, ast.For, ast.With, ast.Try, ast.While)):
                for part in inner:
                    if isinstance(part, ast.ExceptHandler):
                        yield from _statements(part.body)
                    else:
                        yield from _statements([part])


class _Walker:
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
        found: dict[str, str] = {}
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
                    found.update(self.places(value, key))
                elif isinstance(name, ast.Constant) and isinstance(name.value, str):
                    self._put(found, keys.child(key, name.value), name.lineno, value)
        elif isinstance(node, (ast.List, ast.Tuple)):
            for index, item in enumerate(node.elts):
                if isinstance(item, ast.Starred):  # what follows has an unknown index
                    break
                self._put(found, keys.child(key, index), item.lineno, item)
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitOr):
            found.update(self.places(node.left, key))
            found.update(self.places(node.right, key))
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
            found.update(self.places(node.left, key))  # the right side's indices are unknown
        return found

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
                    line = getattr(word, "lineno", node.lineno)
                    self._put(found, keys.child(key, word.arg), line, word.value)
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
            return keys.child(outer, node.slice.value)
    return None


def _name(node: ast.expr) -> str:
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")
