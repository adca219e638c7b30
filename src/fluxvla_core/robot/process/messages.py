"""Messages between the two processes of a robot: a kind, JSON values, and arrays of float64.

Nothing is pickled: a message can make numbers and text, no objects.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core import errors
from fluxvla_core.errors import FluxError, RunFailed
from fluxvla_core.robot.control import safety, source

Array = npt.NDArray[np.float64]
_HEADER = struct.Struct("<I")
_FIELDS = ("what", "where", "cause", "next")
_ALIGNED = 8
_JSON = json.JSONEncoder(separators=(",", ":"))


@dataclass(frozen=True)
class Message:
    """One message.

    Args:
        kind: what it says.
        fields: JSON values.
        arrays: float64, of any shape.
    """

    kind: str
    fields: Mapping[str, Any] = field(default_factory=dict)
    arrays: Sequence[Array] = ()

    def __getitem__(self, name: str) -> Any:
        return self.fields[name]


def encode(message: Message) -> bytes:
    """``message`` as bytes."""
    arrays = [np.asarray(array, dtype=np.float64) for array in message.arrays]
    shapes = [array.shape for array in arrays]
    header = _JSON.encode([message.kind, message.fields, shapes]).encode()
    # Spaces, so that the numbers after it are aligned in memory.
    header += b" " * (-(_HEADER.size + len(header)) % _ALIGNED)
    return b"".join([_HEADER.pack(len(header)), header, *(array.tobytes() for array in arrays)])


def decode(data: bytes) -> Message:
    """The message that ``encode`` made bytes of; its arrays are read-only."""
    (length,) = _HEADER.unpack_from(data)
    end = _HEADER.size + length
    kind, fields, shapes = json.loads(data[_HEADER.size : end])
    arrays = []
    for shape in shapes:
        count = int(np.prod(shape, dtype=np.int64))
        arrays.append(np.frombuffer(data, np.float64, count, end).reshape(shape))
        end += count * 8
    return Message(kind, fields, tuple(arrays))


def error_fields(error: BaseException) -> dict[str, Any]:
    """``error`` as JSON values: its class and bases by name, its rule, and its message."""
    names = [cls.__name__ for cls in type(error).__mro__]
    if isinstance(error, FluxError):
        said = {name: getattr(error, name) for name in _FIELDS}
        return {"error": names, "rule": error.rule, **said}
    return {"error": names, "rule": "", "what": f"{type(error).__name__}: {error}"}


def error_of(fields: Mapping[str, Any]) -> FluxError:
    """The error of ``error_fields``, of the nearest class that is known here."""
    found = next((_KNOWN[name] for name in fields["error"] if name in _KNOWN), RunFailed)
    said = {name: fields.get(name) for name in _FIELDS[1:]}
    error = found(fields["what"], **said)
    if error.rule != fields["rule"]:
        # A class of a plugin: what it is called is lost, which rule it belongs to is not.
        error.rule = fields["rule"]  # type: ignore[misc]
    return error


def _classes(*modules: Any) -> dict[str, type[FluxError]]:
    found = [value for module in modules for value in vars(module).values()]
    return {c.__name__: c for c in found if isinstance(c, type) and issubclass(c, FluxError)}


_KNOWN = _classes(errors, safety, source)
