"""The sizes of the batches that a model takes, read from a config without building the model.

A model's class says which arguments of its constructor decide about them (``VLA.input_sizes``);
the config has their values.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from fluxvla_core.build import class_of, constructors
from fluxvla_core.config.resolve import SLOTS
from fluxvla_core.contracts.contract import implements
from fluxvla_core.contracts.training import InputSizes, Size, Tokenizer
from fluxvla_core.errors import FluxError
from fluxvla_core.plugins.registry import BY_NAME, VLAS

_WORDS = {
    "cameras": "the number of cameras",
    "image_size": "the size of images",
    "states": "the width of states",
    "actions": "the width of actions",
    "horizon": "the number of actions in a chunk",
}
_PADDED = "states and actions have the robot's widths, or those that a transform pads them to"
_ADVICE = {
    "cameras": "the cameras are img_keys of the dataset",
    "image_size": "let a transform resize images",
    "states": _PADDED,
    "actions": _PADDED,
    "vocabulary": "let the transforms' tokenizer be the one of the model",
    "horizon": "the chunk is as long as action_window_size of the dataset",
    "embodiments": "embodiment_id of the dataset is the robot's number",
    "float_images": "let a transform normalise images",
}


@dataclass(frozen=True)
class Declared:
    """A size that a model takes; ``key`` is the argument that says so, empty where none does."""

    key: str
    value: Any


@dataclass(frozen=True)
class Misfit:
    """A size of a batch that a model does not take: the key below ``model``, and both values."""

    size: str
    key: str
    text: str


def declared_sizes(table: Any) -> dict[str, Declared]:
    """The input sizes of the model that ``table`` describes, by the fields of ``InputSizes``.

    Raises:
        ConfigError, PluginError: the class, or that of a part, cannot be loaded.
    """
    if not isinstance(table, Mapping):
        return {}  # a model that is built already
    cls = class_of(table.get("type"), VLAS)
    stated = getattr(cls, "input_sizes", None)
    found: dict[str, Declared] = {}
    if not isinstance(stated, InputSizes):
        return found
    for field in fields(InputSizes):
        one = _read(cls, table, getattr(stated, field.name))
        if one is not None:
            found[field.name] = one
    return found


def chunk_of(sizes: Mapping[str, Declared]) -> tuple[int, int] | None:
    """``(T, D)`` of the chunks, where both are declared."""
    both = [sizes[name].value for name in ("horizon", "actions") if name in sizes]
    return (both[0], both[1]) if len(both) == 2 else None


def vocabulary_of(sizes: Mapping[str, Declared]) -> int | None:
    """The number of tokens that the model embeds, where it is declared."""
    return sizes["vocabulary"].value if "vocabulary" in sizes else None


def misfits(
    table: Any,
    batch: Mapping[str, Any],
    sizes: Mapping[str, Declared] | None = None,
    data: str = "the data",
    tokens: int = 0,
) -> list[Misfit]:
    """Where ``batch`` has other sizes than the model of ``table`` takes.

    Args:
        batch: as a collator or a policy's preparation makes it: tensors ``(B, …)``, or a list with
            an entry for each sample. What it does not have is not compared.
        sizes: those of ``table``, if they are known.
        data: where the batch is from, for the text.
        tokens: number of ids that its tokenizer has, see ``token_count``: another instruction than
            that of ``batch`` may have any of them.
    """
    sizes = declared_sizes(table) if sizes is None else sizes
    if not sizes:
        return []
    who = getattr(class_of(table["type"], VLAS), "__name__", str(table["type"]))
    found = []
    for size, have in _sizes_of(batch, tokens).items():
        one = sizes.get(size)
        if one is None or _fits(size, one.value, have):
            continue
        if size == "embodiments":
            text = f"embodiment_ids are below {one.value}, in {data} one is {have}"
        elif size == "vocabulary":
            text = f"ids of tokens are below {one.value}, in {data} they go up to {have}"
        elif size == "float_images":
            text = f"images are normalised floats, in {data} they are {have}"
        else:
            takes, has = (_shown(size, value) for value in (one.value, have))
            text = f"{_WORDS[size]} is {takes}, in {data} it is {has}"
        found.append(Misfit(size, one.key, f"{who}: {text}"))
    return found


def advice(found: Iterable[Misfit]) -> str:
    """What to change for ``found``."""
    return "; ".join(dict.fromkeys(_ADVICE[one.size] for one in found))


def _read(cls: type, table: Mapping[str, Any], stated: Size) -> Declared | None:
    if stated is None or stated is False:
        return None
    names: Any = stated
    function: Any = None
    if isinstance(stated, tuple):
        names, function = stated
    if not isinstance(names, str):
        return Declared("", stated)
    for name in names.split(" | "):
        try:
            value = _argument(cls, table, name)
            value = value if function is None else function(value)
        except (FluxError, TypeError, ValueError, AttributeError, KeyError):
            continue  # an argument that makes no sense: the constructor explains it
        whole = [value] if isinstance(value, int) else value
        if isinstance(whole, list | tuple) and all(isinstance(n, int) for n in whole):
            return Declared(name, value)
    return None


def _argument(cls: type, table: Mapping[str, Any], name: str) -> Any:
    """The value of an argument or its default, ``part.argument`` or ``table.key`` of a table's."""
    first, _, rest = name.partition(".")
    value = table[first] if first in table else _default(cls, first)
    if not rest or value is None:
        return value
    if not isinstance(value, Mapping):
        return getattr(value, rest, None)  # a part that is built already
    if first not in SLOTS:  # a table of sizes
        found: Any = value
        for key in rest.split("."):
            found = found.get(key)
        return found
    inner = class_of(value.get("type"), BY_NAME[SLOTS[first]])
    return _argument(inner, value, rest)


def _default(cls: type, name: str) -> Any:
    """The default of a constructor's argument, following ``**kwargs`` into base classes."""
    for found in constructors(cls):
        if name in found:
            default = found[name].default
            return None if default is inspect.Parameter.empty else default
    return None


def largest_token(batch: Mapping[str, Any]) -> int:
    """The largest id of a batch's ``lang_tokens``; -1 without any."""
    tokens = batch.get("lang_tokens")
    return -1 if tokens is None or not np.size(tokens) else int(np.max(np.asarray(tokens)))


def token_count(pipeline: Any) -> int:
    """Ids, without added tokens, that the tokenizers of a ``Pipeline`` have; 0 if unknown."""
    found = (getattr(t, "tokenizer", None) for t in getattr(pipeline, "transforms", ()))
    tokenizers = (Tokenizer.adapt(t) for t in found if implements(t, Tokenizer, "encode"))
    return max((t.base_vocab_size or 0 for t in tokenizers), default=0)


def _sizes_of(batch: Mapping[str, Any], tokens: int) -> dict[str, Any]:
    """The sizes that a batch has, by the fields of ``InputSizes``."""
    found: dict[str, Any] = {}
    images, states, actions = (_shape(batch.get(key)) for key in ("images", "states", "actions"))
    if len(images) > 2:
        found["cameras"], found["image_size"] = images[-3] // 3, images[-2:]
        kind = str(getattr(batch["images"], "dtype", "")).removeprefix("torch.")
        found["float_images"] = kind
    if states:
        found["states"] = states[-1]
    if len(actions) > 1:
        found["horizon"], found["actions"] = actions[-2:]
    ids = batch.get("embodiment_ids")
    if ids is not None and np.size(ids):
        found["embodiments"] = int(np.max(np.asarray(ids)))
    highest = max(largest_token(batch), tokens - 1)
    if highest >= 0:
        found["vocabulary"] = highest
    return found


def _shape(value: Any) -> tuple[int, ...]:
    """The shape of a sample's entry: of a tensor ``(B, …)``, or of the first in a list."""
    if isinstance(value, list | tuple):
        return tuple(np.shape(value[0])) if value else ()
    return tuple(getattr(value, "shape", ()))[1:]


def _fits(size: str, takes: Any, has: Any) -> bool:
    if size in ("embodiments", "vocabulary"):
        return 0 <= int(has) < int(takes)
    if size == "float_images":
        return "float" in has or not has
    if size == "image_size":
        return tuple(has) == ((takes, takes) if isinstance(takes, int) else tuple(takes))
    return bool(takes == has)


def _shown(size: str, value: Any) -> str:
    if size != "image_size":
        return str(value)
    height, width = (value, value) if isinstance(value, int) else value
    return f"{height} x {width}"
