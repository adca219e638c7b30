"""Parse source files: classes, their bases and docstrings, without importing anything."""

from __future__ import annotations

import ast
import builtins
import functools
import inspect
import re
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from fluxvla_core.plugins.load import locate, place

# Bases that no constructor parameter of ours comes from; parsing torch would take a second.
_PLAIN = frozenset(
    {
        "object",
        "abc.ABC",
        "typing.Generic",
        "typing.Protocol",
        "typing_extensions.Protocol",
        "torch.nn.Module",
        "torch.nn.modules.module.Module",
    }
)
# A method other than __init__ of a class at the top: its header, and the lines of its body.
_METHOD = re.compile(
    r"^(?P<header>    (?:async )?def (?!__init__\b)\w+\((?:(?!\n *(?:async )?def |\n\S).)*?:)"
    r"[ ]*(?:#[^\n]*)?\n(?P<body>(?:(?:     [^\n]*)?\n)+)",
    re.MULTILINE | re.DOTALL,
)
_CLOSED = frozenset(sys.stdlib_module_names | {"torch", "numpy"})


@dataclass(frozen=True, eq=False)
class Module:
    """One parsed source file; ``names`` maps its top-level names to their nodes."""

    name: str
    path: Path
    names: dict[str, ast.AST]
    stars: tuple[str, ...]

    def place(self, line: int) -> str:
        return place(self.path, self.name, line)


@dataclass(frozen=True)
class Source:
    """A class or function definition and the module that it stands in."""

    module: Module
    node: ast.ClassDef | ast.FunctionDef

    @property
    def place(self) -> str:
        return self.module.place(self.node.lineno)


@dataclass(frozen=True)
class Opaque:
    """A base class that is not followed. ``plain``: it takes no constructor parameters."""

    name: str

    @property
    def plain(self) -> bool:
        return self.name in _PLAIN


Base = Source | Opaque


def syntax_error(dotted: str) -> str | None:
    """``file:line`` and the syntax error of a module in ``dotted``; None if there is none."""
    parts = dotted.split(".")
    for end in range(len(parts), 0, -1):
        name = ".".join(parts[:end])
        path = _file(name)
        if path is None:
            continue
        try:
            ast.parse(path.read_bytes(), str(path))
        except SyntaxError as error:
            return f"{place(path, name, error.lineno or 1)}: {error.msg}"
        except ValueError as error:  # a NUL, before Python 3.12
            return f"{place(path, name, 1)}: {error}"
    return None


def _file(name: str) -> Path | None:
    """The source file of a module, where there is one that is ours to read."""
    path = None if name.partition(".")[0] in _CLOSED else locate(name)
    return path if path is not None and path.suffix == ".py" and path.is_file() else None


@functools.cache
def parse(name: str) -> Module | None:
    """The module called ``name``, or None where there is no source that can be read."""
    path = _file(name)
    if path is None:
        return None
    tree = _tree(path)
    if tree is None:
        return None  # ``syntax_error`` says why
    names: dict[str, ast.AST] = {}
    stars = []
    for node in _top(tree.body):
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)):
            names[node.name] = node
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            for alias in node.names:
                if alias.name == "*" and isinstance(node, ast.ImportFrom):
                    stars.append(_absolute(node, name, path))
                names[alias.asname or alias.name.partition(".")[0]] = node
        elif isinstance(node, ast.Assign):
            for target in node.targets:
                value = node.value if isinstance(target, ast.Name) else node  # of a, b = ...
                names.update(dict.fromkeys(_stored(target), value))
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value:
            names[node.target.id] = node.value
    return Module(name, path, names, tuple(stars))


def _tree(path: Path) -> ast.Module | None:
    """The statements of a file without the bodies of methods.

    Nothing here reads them, they are most of a file, and parsing takes most of the time of
    ``fluxvla config check``.
    """
    source = path.read_bytes()
    with suppress(SyntaxError, ValueError):
        return ast.parse(_METHOD.sub(_without_body, source.decode()), str(path))
    with suppress(SyntaxError, ValueError):  # a string in some body has lines without indentation
        return ast.parse(source, str(path))
    return None


def _without_body(method: re.Match[str]) -> str:
    lines = method[0].count("\n", len(method["header"]))  # so that all below keeps its place
    return f"{method['header']} ..." + "\n" * lines


def _stored(target: ast.expr) -> list[str]:
    """The names that an assignment to ``target`` defines; ``a.b`` and ``a[b]`` define none."""
    found = (n for n in ast.walk(target) if isinstance(n, ast.Name))
    return [name.id for name in found if isinstance(name.ctx, ast.Store)]


def _top(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Statements in the order in which a later one should win: fallbacks before the real thing."""
    for node in body:
        yield node
        if isinstance(node, ast.If):
            yield from _top([*node.orelse, *node.body])
        elif isinstance(node, (ast.With, ast.For)):
            yield from _top(node.body)
        elif isinstance(node, ast.Try):
            for handler in node.handlers:
                yield from _top(handler.body)
            yield from _top([*node.body, *node.orelse, *node.finalbody])


def _absolute(node: ast.ImportFrom, module: str, path: Path) -> str:
    if not node.level:
        return node.module or ""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for _ in range(node.level - 1):
        package = package.rpartition(".")[0]
    return f"{package}.{node.module}" if node.module else package


def find(module: str, dotted: str, seen: frozenset[tuple[str, str]] = frozenset()) -> Base:
    """Resolve ``dotted`` in ``module``, following imports, aliases and lazy ``_EXPORTS``."""
    whole = f"{module}.{dotted}" if module else dotted
    parsed = parse(module)
    if parsed is None or (module, dotted) in seen:
        return Opaque(whole)
    seen = seen | {(module, dotted)}
    first, _, rest = dotted.partition(".")
    node = parsed.names.get(first)
    if isinstance(node, ast.ClassDef):
        return _inside(parsed, node, rest, whole)
    if isinstance(node, ast.FunctionDef) and not rest:
        return Source(parsed, node)
    if isinstance(node, ast.ImportFrom):
        return _imported(parsed, node, first, rest, seen)
    if isinstance(node, ast.Import):
        return _plain_import(node, first, rest, seen)
    if isinstance(node, (ast.Name, ast.Attribute)):
        alias = dotted_name(node)
        if alias:
            return find(module, f"{alias}.{rest}" if rest else alias, seen)
    return _elsewhere(parsed, first, rest, whole, seen)


def _inside(parsed: Module, node: ast.ClassDef, rest: str, whole: str) -> Base:
    """The nested class ``rest`` (dotted) of ``node``."""
    if not rest:
        return Source(parsed, node)
    part, _, rest = rest.partition(".")
    inner = member(Source(parsed, node), part)
    if isinstance(inner, Source) and isinstance(inner.node, ast.ClassDef):
        return _inside(inner.module, inner.node, rest, whole)
    return Opaque(whole)


def member(cls: Source, name: str) -> Base | None:
    """The class attribute ``name`` in the body of ``cls``; None if it has none.

    It is a nested class, or names a class: ``Name = module.Class``.
    """
    for node in cls.node.body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            return Source(cls.module, node)
    value = assigned(cls.node, name)
    if value is None:
        return None
    named = dotted_name(value)
    return find(cls.module.name, named) if named else Opaque(ast.unparse(value))


def assigned(node: ast.ClassDef | ast.FunctionDef, name: str) -> ast.expr | None:
    """The value that the body of a class gives its attribute ``name``; None if it gives none."""
    found: ast.expr | None = None
    for inner in node.body:
        if isinstance(inner, (ast.Assign, ast.AnnAssign)) and inner.value is not None:
            targets = inner.targets if isinstance(inner, ast.Assign) else [inner.target]
            if any(isinstance(t, ast.Name) and t.id == name for t in targets):
                found = inner.value
    return found


def _imported(
    parsed: Module, node: ast.ImportFrom, first: str, rest: str, seen: frozenset[tuple[str, str]]
) -> Base:
    original = next(a.name for a in node.names if (a.asname or a.name) == first)
    origin = _absolute(node, parsed.name, parsed.path)
    target = find(origin, f"{original}.{rest}" if rest else original, seen)
    if isinstance(target, Opaque) and rest and parse(f"{origin}.{original}") is not None:
        return find(f"{origin}.{original}", rest, seen)
    return target


def _plain_import(
    node: ast.Import, first: str, rest: str, seen: frozenset[tuple[str, str]]
) -> Base:
    """``import a.b as c; c.X`` and ``import a.b; a.b.X``."""
    alias = next(a for a in node.names if (a.asname or a.name.partition(".")[0]) == first)
    parts = [*(alias.name if alias.asname else first).split("."), *rest.split(".")]
    for cut in range(len(parts) - 1, 0, -1):
        module = ".".join(parts[:cut])
        if parse(module) is not None:
            return find(module, ".".join(parts[cut:]), seen)
    return Opaque(".".join(parts))


def _elsewhere(
    parsed: Module, first: str, rest: str, whole: str, seen: frozenset[tuple[str, str]]
) -> Base:
    """A name from a star import, a submodule, or a lazy export table (PEP 562)."""
    for origin in parsed.stars:
        found = find(origin, f"{first}.{rest}" if rest else first, seen)
        if isinstance(found, Source):
            return found
    exports = parsed.names.get("_EXPORTS")
    if isinstance(exports, ast.Dict):
        for key, value in zip(exports.keys, exports.values, strict=True):
            if (
                isinstance(key, ast.Constant)
                and key.value == first
                and isinstance(value, ast.Constant)
            ):
                return find(str(value.value), f"{first}.{rest}" if rest else first, seen)
    if rest and parse(f"{parsed.name}.{first}") is not None:
        return find(f"{parsed.name}.{first}", rest, seen)
    return Opaque(first if hasattr(builtins, first) else whole)


def lacks(module: str, dotted: str) -> bool:
    """Whether ``module`` certainly defines nothing called ``dotted``."""
    parsed = parse(module)
    if parsed is None or parsed.stars or "__getattr__" in parsed.names:
        return False
    return dotted.partition(".")[0] not in parsed.names


def dotted_name(node: ast.expr) -> str | None:
    """``a.b.C`` of a base-class expression; the parameters of a generic are left out."""
    if isinstance(node, ast.Subscript):
        return dotted_name(node.value)
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        outer = dotted_name(node.value)
        return f"{outer}.{node.attr}" if outer else None
    return None


def linearize(cls: Source) -> list[Base]:
    """Method resolution order (C3, https://docs.python.org/3/howto/mro.html)."""
    if not isinstance(cls.node, ast.ClassDef):
        return [cls]
    bases: list[Base] = []
    for expression in cls.node.bases:
        name = dotted_name(expression)
        bases.append(find(cls.module.name, name) if name else Opaque(ast.unparse(expression)))
    rows: list[list[Base]] = [linearize(b) if isinstance(b, Source) else [b] for b in bases]
    return [cls, *_merge([*rows, bases])]


def _merge(rows: list[list[Base]]) -> list[Base]:
    order: list[Base] = []
    rows = [row for row in rows if row]
    while rows:
        for row in rows:
            head = row[0]
            if not any(head in other[1:] for other in rows):
                break
        else:
            head = rows[0][0]  # Python itself refuses such bases when the class is loaded
        order.append(head)
        rows = [rest for row in rows if (rest := [b for b in row if b != head])]
    return order


_SECTION = re.compile(r"^(\s*)Args:\s*$", re.MULTILINE)
_ENTRY = re.compile(r"^(\*{0,2}\w+(?:, \*{0,2}\w+)*)(?: \([^)]*\))?:\s*(.*)$")


def argument_texts(docstring: str | None) -> dict[str, str]:
    """Parameter -> its description, on one line; empty where there is no such section.

    ``height, width: of the images`` describes both.
    """
    text = inspect.cleandoc(docstring or "")
    section = _SECTION.search(text)
    if section is None:
        return {}
    margin = len(section[1])
    found: dict[str, str] = {}
    names: list[str] = []
    inner: int | None = None
    for line in text[section.end() :].splitlines():
        if not line.strip():
            continue
        indent = len(line) - len(line.lstrip())
        if indent <= margin:  # the next section, or text after it
            break
        inner = indent if inner is None else inner
        entry = _ENTRY.match(line.strip()) if indent == inner else None
        if entry:
            names = [name.strip("* ") for name in entry[1].split(",")]
            found.update(dict.fromkeys(names, entry[2].strip()))
        else:
            for name in names:
                found[name] = f"{found[name]} {line.strip()}".strip()
    return found


def field_texts(node: ast.ClassDef) -> dict[str, str]:
    """Attribute docstrings: the string below ``name: type = default``."""
    found = {}
    for stated, below in pairwise(node.body):
        if (
            isinstance(stated, ast.AnnAssign)
            and isinstance(stated.target, ast.Name)
            and isinstance(below, ast.Expr)
            and isinstance(below.value, ast.Constant)
            and isinstance(below.value.value, str)
        ):
            found[stated.target.id] = " ".join(below.value.value.split())
    return found
