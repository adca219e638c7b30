"""Read untrusted files: regular files of bounded size, and JSON validated against a type.

Every JSON file of a dataset, a checkpoint, a recording or a plugin is read here, so that a pipe, a
device, gigabytes, deep nesting or a value of another type is an error that names file and field.
"""

from __future__ import annotations

import functools
import json
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from fluxvla_core.errors import FluxError

if TYPE_CHECKING:
    from pydantic import TypeAdapter

T = TypeVar("T")

AT_MOST = 64 << 20
"""Bytes of a metadata file; the largest that are published have a few MB."""
_SHOWN = 5  # problems of one file in a message


def read_bytes(path: Path, error: type[FluxError], *, at_most: int = AT_MOST) -> bytes:
    """The content of a regular file.

    Raises:
        error: it is missing, cannot be read, is not a regular file (a pipe, a device, a folder), or
            holds more than ``at_most`` bytes.
    """
    try:
        # Without O_NONBLOCK, opening a pipe waits for a writer.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
        with os.fdopen(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise error("is not a regular file, so it is not read", where=str(path))
            content = file.read(at_most + 1)
    except (OSError, ValueError) as problem:  # ValueError: a NUL in the name
        reason = getattr(problem, "strerror", None) or str(problem)
        raise error(f"cannot be read: {reason}", where=str(path)) from problem
    if len(content) > at_most:
        raise error(
            f"holds more than {at_most >> 20} MiB, which no file of its kind does",
            where=str(path),
        )
    return content


def read_json(path: Path, kind: type[T], error: type[FluxError]) -> T:
    """The JSON in a file, as a ``kind``; see ``parse_json``.

    Raises:
        error: see ``read_bytes`` and ``parse_json``.
    """
    return parse_json(read_bytes(path, error), kind, error, str(path))


def parse_json(content: bytes | str, kind: type[T], error: type[FluxError], where: str) -> T:
    """JSON as a ``kind``: a dataclass, a TypedDict, ``dict[str, float]``, …

    Types are checked strictly: ``"3"`` and ``true`` are not numbers. Fields that ``kind`` does not
    have are ignored.

    Raises:
        error: it is not JSON, nested deeper than 200, or a field is missing or of another type.
    """
    return _validated(
        lambda adapter: adapter.validate_json(content, strict=True), kind, error, where
    )


def checked(value: object, kind: type[T], error: type[FluxError], where: str) -> T:
    """``value``, which was parsed before, as a ``kind``; as strict as ``parse_json``.

    Raises:
        error: a field is missing or of another type, or it is not a JSON value.
    """
    try:
        content = json.dumps(value)
    except (TypeError, ValueError, RecursionError) as problem:
        raise error(f"it holds no plain values: {problem}", where=where) from problem
    return parse_json(content, kind, error, where)


def _validated(
    validate: Callable[[TypeAdapter[Any]], T], kind: type[T], error: type[FluxError], where: str
) -> T:
    from pydantic import ValidationError

    try:
        # To typeshed, a class may be unhashable.
        return validate(_adapter(kind))  # type: ignore[arg-type]
    except ValidationError as invalid:
        # Without the values: those of a damaged file may be of any length.
        found = invalid.errors(include_url=False, include_context=False, include_input=False)
        problems = [_described(one["loc"], one["msg"]) for one in found[:_SHOWN]]
        if len(found) > _SHOWN:
            problems.append(f"and {len(found) - _SHOWN} more")
        raise error("; ".join(problems), where=where) from None


def _described(place: tuple[int | str, ...], message: str) -> str:
    """``features.state.shape.0: input should be a valid integer``."""
    dotted = ".".join(str(part)[:80] for part in place)
    text = message[:1].lower() + message[1:]
    return f"{dotted}: {text}" if dotted else text


@functools.cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)
