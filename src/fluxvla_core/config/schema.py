"""JSON Schema (draft 2020-12) of configs, for the installed plugins.

For editors: names of sections and keys, ``type`` from the registries, and each class's parameters
with types, defaults and descriptions, read without importing a plugin. ``config check`` finds more,
such as a required key that neither a file nor its ``_base_`` sets.

A file with ``_base_`` has parts of tables, and so has a variable that is composed into others:
there, nothing is required. Every definition therefore exists twice, ``whole:…`` and ``part:…``.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from fluxvla_core.config.check import REQUIRES
from fluxvla_core.config.load import BASE
from fluxvla_core.config.parameters import Parameter
from fluxvla_core.config.resolve import INJECTED, LOADERS, SEARCHED, SLOTS, Found, installed
from fluxvla_core.config.runtime_signature import inspect_signature
from fluxvla_core.config.signature import Signature, table_of
from fluxvla_core.config.source import dotted_name
from fluxvla_core.config.tree import DELETE
from fluxvla_core.errors import PluginError
from fluxvla_core.plugins._metadata import CORE, version
from fluxvla_core.plugins.load import is_core
from fluxvla_core.plugins.registry import BY_NAME
from fluxvla_core.registries import BY_NAME as ROWS

Schema = dict[str, Any]
DIALECT = "https://json-schema.org/draft/2020-12/schema"
_WHOLE, _PART = "whole", "part"
# A table under these may hold others by name instead of being of a class itself.
_MAY_GROUP = frozenset({"datasets", "hooks", "action_filters"})
_ALWAYS_TABLES = frozenset({"transforms"})
_QUALIFIED = "^[A-Za-z0-9._-]+:.+$"


@dataclass(frozen=True)
class _Class:
    """One class under the names that a config may call it by, the first of them preferred."""

    names: tuple[str, ...]
    found: Found


def config_schema() -> Schema:
    """The schema of every config file; plain JSON values."""
    classes = {registry: list(_classes(registry)) for registry in SEARCHED}
    definitions: Schema = {}
    for kind in (_WHOLE, _PART):
        definitions |= {f"{kind}:file": _file(kind)}
        definitions |= {f"{kind}:{name}": _loader(kind) for name in LOADERS}
        for registry, found in classes.items():
            definitions[f"{kind}:{registry}"] = _slot(kind, registry, found)
            for one in found:
                definitions[f"{kind}:{registry}:{one.names[0]}"] = _table(kind, one.found)
    definitions["section"] = _section(classes["runners"])
    # A table of an unknown class: its values are known by the names of their keys.
    tables = {name: {"$ref": _ref(_PART, registry)} for name, registry in SLOTS.items()}
    definitions["untyped"] = {"properties": tables}
    return {
        "$schema": DIALECT,
        "title": "FluxVLA config",
        "description": f"What fluxvla-core {version(CORE)} and the plugins installed with it take.",
        "type": "object",
        "if": {"required": [BASE]},
        "then": {"$ref": _ref(_PART, "file")},
        "else": {"$ref": _ref(_WHOLE, "file")},
        "$defs": definitions,
    }


def _ref(*parts: str) -> str:
    """A reference (RFC 6901, as a URI fragment): a plugin's name may have any letters."""
    return "#/$defs/" + quote(":".join(parts).replace("~", "~0").replace("/", "~1"), safe="~:")


def _classes(registry: str) -> Iterable[_Class]:
    """Every class of a registry that a config can name, without broken ones."""
    group = BY_NAME[registry]
    registered = [name for name in group if group.registered(name) is not None]
    for name in registered:
        signature = inspect_signature(group.registered(name))
        resolved = Found(registry, name, "registered in this process", signature)
        yield _Class((name,), resolved)
    for name, plugins in sorted(group.installed().items()):
        preferred = [p for p in plugins if is_core(p)] or (plugins if len(plugins) == 1 else [])
        for plugin in plugins:
            qualified = f"{plugin.dist}:{name}"
            plain = plugin in preferred and name not in registered
            try:
                resolved = installed(plugin)
            except PluginError:  # reported by ``plugins doctor`` and ``config check``
                continue
            yield _Class((name, qualified) if plain else (qualified,), resolved)


def _file(kind: str) -> Schema:
    properties: Schema = {
        BASE: {
            "description": "A file, or several, whose values this config inherits.",
            "type": ["string", "array"],
            "items": {"type": "string"},
        },
        REQUIRES: {
            "description": "Distributions that this config needs (PEP 508): 'fluxvla-ur>=0.3'.",
            "type": "array",
            "items": {"type": "string"},
        },
    }
    properties |= {name: {"$ref": _ref(kind, registry)} for name, registry in SLOTS.items()}
    properties |= {name: {"$ref": _ref(kind, name)} for name in LOADERS}
    return {
        "type": "object",
        "properties": properties,
        "additionalProperties": {"$ref": _ref("section")},
    }


def _section(runners: list[_Class]) -> Schema:
    """Another top-level name: a section where its type is a runner's, else a variable."""
    names = [name for one in runners for name in one.names]
    return {
        "if": {
            "type": "object",
            "properties": {"type": {"enum": names}},
            "required": ["type"],
        },
        "then": {"$ref": _ref(_PART, "runners")},
        "else": {"$ref": _ref("untyped")},
    }


def _loader(kind: str) -> Schema:
    """``train_dataloader``; another runner may read keys of its own there."""
    return {
        "type": ["object", "null"],
        "properties": {
            "per_device_batch_size": {
                "type": "integer",
                "description": "samples in a batch of each process.",
            },
            "per_device_num_workers": {
                "type": "integer",
                "description": "processes that load data for each process that trains.",
            },
            "shuffle_episodes": {"type": ["boolean", "null"]},
            "dataset": {"$ref": _ref(kind, "datasets")},
        },
    }


def _slot(kind: str, registry: str, classes: list[_Class]) -> Schema:
    """A value under a key that takes classes of ``registry``: a table, or a list of such.

    Other values (a policy may be a word, a metric an object's name) are left to the class.
    """
    names = [one.names[0] for one in classes]
    named: Schema = {
        "description": f"a class of fluxvla.{registry}",
        "anyOf": [{"enum": names}, {"type": "string", "pattern": _QUALIFIED}],
    }
    if not names:
        named = {"type": "string", "pattern": _QUALIFIED}
    slot: Schema = {
        "description": ROWS[registry].about,
        "items": {"$ref": _ref(kind, registry)},
        "properties": {"type": named},
    }
    cases: list[Schema] = [
        {
            "if": {"properties": {"type": {"enum": list(one.names)}}, "required": ["type"]},
            "then": {"$ref": _ref(kind, registry, one.names[0])},
        }
        for one in classes
    ]
    if kind == _PART:
        cases.append({"if": {"not": {"required": ["type"]}}, "then": {"$ref": _ref("untyped")}})
    if cases:
        slot["allOf"] = cases
    if registry in _ALWAYS_TABLES:
        slot["type"] = ["object", "array", "null"]
    if registry == "hooks":
        slot["if"] = {"type": "string"}
        slot["then"] = named
    if kind == _WHOLE and registry not in _MAY_GROUP:
        # An empty table may be filled in by another file.
        slot["if"] = {"type": "object", "minProperties": 1}
        slot["then"] = {"required": ["type"]}
    return slot


def _table(kind: str, found: Found) -> Schema:
    """The keys of a table of one class."""
    signature = found.signature
    about = {"title": found.title, "description": f"from {found.origin}"}
    if signature is None:
        return about
    if signature.doc:
        about["description"] = f"{signature.doc} ({found.origin})"
    table = {**about, **_keys(kind, signature)}
    required = [p.name for p in signature.parameters if p.required and p.name not in INJECTED]
    if kind == _WHOLE and required:
        table["required"] = ["type", *required]
    return table


def _keys(kind: str, signature: Signature) -> Schema:
    meanings = signature.meanings
    properties: Schema = {"type": True, DELETE: {"type": "boolean"}}
    for parameter in signature.parameters:
        if parameter.name not in INJECTED:
            properties[parameter.name] = _parameter(kind, parameter, meanings.get(parameter.name))
    if signature.open:
        properties |= dict.fromkeys(INJECTED, False)
    return {"properties": properties, "additionalProperties": signature.open}


def _parameter(kind: str, parameter: Parameter, meaning: str | None) -> Schema:
    registry = SLOTS.get(parameter.name)
    if registry is not None:
        schema: Schema = {"$ref": _ref(kind, registry)}
    else:
        schema = value_schema(parameter, lambda table: _keys(kind, table))
    default: Any = default_value(parameter)
    said = [meaning] if meaning else []
    if default is not None:
        schema["default"] = default[0]
    elif parameter.default is not None:
        said.append(f"Default: {parameter.default}")
    if said:
        schema["description"] = " ".join(said)
    return schema


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
