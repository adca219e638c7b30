"""JSON Schema of values, from the annotations that sources state; nothing is imported."""

from __future__ import annotations

import ast
import math
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from fluxvla_core.config.parameters import Parameter
from fluxvla_core.config.signature import Signature, table_of
from fluxvla_core.config.source import dotted_name

Schema = dict[str, Any]

_SCALARS = {
    "bool": "boolean",
    "int": "integer",
    "float": "number",
    "str": "string",
    "Path": "string",
    "PurePath": "string",
    "None": "null",
}
_LISTS = frozenset(
    {"list", "List", "Sequence", "MutableSequence", "Iterable", "Collection", "set", "frozenset"}
)
_TABLES = frozenset({"dict", "Dict", "Mapping", "MutableMapping"})


def value_schema(parameter: Parameter, nested: Callable[[Signature], Schema]) -> Schema:
    """JSON Schema of a parameter's annotation; ``{}``, which allows all, without one.

    Args:
        nested: the schema of a table that a dataclass or a ``TypedDict`` describes.
    """
    annotation, _ = parameter.nodes
    if annotation is None:
        return {}
    table = table_of(parameter)
    if table is None:
        return _of(annotation)
    # One class, alone or with None and Mapping: ``config check`` reads it like this, too.
    nullable = "None" in ast.unparse(annotation) or "Optional" in ast.unparse(annotation)
    return {"type": ["object", "null"] if nullable else "object", **nested(table)}


def default_value(parameter: Parameter) -> tuple[Any] | None:
    """The default, in a tuple, where it is plain data that JSON has; else None."""
    _, default = parameter.nodes
    if default is not None:
        with suppress(ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
            value = ast.literal_eval(default)
            if _is_json(value):
                return (value,)
    return None


def _is_json(value: Any) -> bool:
    if isinstance(value, (list, tuple)):
        return all(map(_is_json, value))
    if isinstance(value, dict):
        return all(isinstance(k, str) and _is_json(v) for k, v in value.items())
    if isinstance(value, float):
        return math.isfinite(value)
    return value is None or isinstance(value, (bool, int, str))


def _of(node: ast.expr) -> Schema:
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitOr):
        return _union([_of(node.left), _of(node.right)])
    if isinstance(node, ast.Constant):
        if node.value is None:
            return {"type": "null"}
        if isinstance(node.value, str):  # "X | None"
            with suppress(SyntaxError):
                return _of(ast.parse(node.value, mode="eval").body)
        return {}
    name = (dotted_name(node) or "").rpartition(".")[2]
    if isinstance(node, ast.Subscript):
        inside = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        return _generic(name, inside)
    if name in _SCALARS:
        return {"type": _SCALARS[name]}
    if name in _LISTS or name in {"tuple", "Tuple"}:
        return {"type": "array"}
    return {"type": "object"} if name in _TABLES else {}


def _generic(name: str, inside: list[ast.expr]) -> Schema:
    if name == "Optional":
        return _union([_of(inside[0]), {"type": "null"}])
    if name == "Union":
        return _union([_of(one) for one in inside])
    if name == "Literal":
        values = [one.value for one in inside if isinstance(one, ast.Constant)]
        return {"enum": values} if len(values) == len(inside) else {}
    if name == "Annotated":
        return _of(inside[0])
    if name in {"tuple", "Tuple"}:
        if len(inside) == 2 and isinstance(inside[1], ast.Constant) and inside[1].value is ...:
            return {"type": "array", "items": _of(inside[0])}
        count = {"minItems": len(inside), "maxItems": len(inside)}
        return {"type": "array", "prefixItems": [_of(one) for one in inside], **count}
    if name in _LISTS:
        return {"type": "array", "items": _of(inside[0])}
    if name in _TABLES and len(inside) == 2:
        # A key that is no text, as of Mapping[int, float], is written as text in every format.
        return {"type": "object", "additionalProperties": _of(inside[1])}
    return {}


def _union(parts: list[Schema]) -> Schema:
    """Any of ``parts``; simple types are joined in one list, which editors show best."""
    if any(not part for part in parts):
        return {}
    types: list[str] = []
    others: list[Schema] = []
    for part in parts:
        if part.keys() == {"type"}:
            types += [part["type"]] if isinstance(part["type"], str) else part["type"]
        else:
            others += part["anyOf"] if part.keys() == {"anyOf"} else [part]
    plain: Schema = {"type": types[0] if len(types) == 1 else sorted(set(types))}
    if not others:
        return plain
    return {"anyOf": [*([plain] if types else []), *others]}
