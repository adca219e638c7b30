"""Base of the conformance kits: building a component, and the checks of its class."""

from __future__ import annotations

import inspect
import json
import traceback
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from fluxvla_core.config.runtime_signature import inspect_signature
from fluxvla_core.contracts.check import check_class
from fluxvla_core.errors import FluxError
from fluxvla_core.plugins.registry import BY_NAME

_LIBRARIES = frozenset({"torch", "numpy"})
_KIT = Path(__file__).parent
_LISTED = 12


class Renamed:
    """Base class of kits some of whose attributes had another name, which still works."""

    image_size: ClassVar[Any]

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        if "picture" in vars(cls):
            message = f"{cls.__name__}.picture is deprecated, use image_size"
            warnings.warn(message, DeprecationWarning, stacklevel=2)
            cls.image_size = vars(cls)["picture"]


class Conformance(Renamed):
    """Inherit one of the kits, set ``entry_point`` and ``arguments``, and run pytest."""

    registry: ClassVar[str]
    entry_point: ClassVar[str]
    """The ``type`` in a config."""
    arguments: ClassVar[Mapping[str, Any]] = {}
    """Constructor arguments."""

    def component(self) -> type:
        """The class that is tested."""
        cls: type = BY_NAME[self.registry].get(self.entry_point)
        return cls

    def make(self) -> Any:
        """A new component; override it for one that takes more than ``arguments``."""
        cls, problem = self.component(), ""
        try:
            inspect.signature(cls).bind(**self.arguments)
        except TypeError as error:
            problem = str(error)
        assert not problem, (
            f"{cls.__name__} cannot be made of arguments = {dict(self.arguments)}: {problem}; set "
            "arguments of this kit's subclass (fluxvla plugins check: --set KEY=VALUE)"
        )
        return cls(**self.arguments)

    def stated(self) -> dict[str, Any]:
        """The arguments of the constructor, with its defaults."""
        parameters = inspect.signature(self.component()).parameters.values()
        defaults = {p.name: p.default for p in parameters if p.default is not p.empty}
        return {**defaults, **self.arguments}

    def test_is_complete(self) -> None:
        cls, problem = self.component(), ""
        try:
            check_class(self.registry, cls, f"{cls.__module__}:{cls.__qualname__}")
        except FluxError as error:
            problem = str(error)
        assert not problem, problem
        core = cls.__module__.startswith("fluxvla_core.")  # its version is the contracts' own
        api = getattr(cls, "api", "1.0" if core else None)
        assert api, (
            f"{cls.__name__}.api is {api!r}, expected '1.0': the version of the contract "
            "that it is written for, by which a later core refuses it in words instead of "
            "failing in the run"
        )

    def test_constructor_names_every_parameter(self) -> None:
        cls = self.component()
        assert not inspect_signature(cls).open, (
            f"{cls.__name__}() takes *args or **kwargs that go nowhere, expected every parameter "
            "by name: config check finds misspelt keys by them"
        )


def capability(has: bool, what: str) -> None:
    """Skip a check of an optional ability that the component does not have.

    Args:
        what: how to provide it.
    """
    if not has:
        pytest.skip(what)


@contextmanager
def calling(what: str, given: Mapping[str, Any], hint: str) -> Iterator[None]:
    """Report an error raised inside with the call and the shapes of its arguments.

    Args:
        what: the call, as source.
        given: name -> value.
        hint: how the kit chooses these values.

    Raises:
        AssertionError: something was raised inside.
    """
    try:
        yield
    except Exception as error:
        raise AssertionError(
            f"{what} raised {raised(error)}; it was given {shapes(given)}: {hint}"
        ) from error


def raised(error: Exception) -> str:
    """An exception with its place in the code that is tested: ``KeyError: 'top' (arm.py:7)``."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if not _LIBRARIES & {*Path(f.filename).parts}]
    last = own[-1] if own else None
    known = last is not None and Path(last.filename).parent != _KIT
    place = f" ({Path(last.filename).name}:{last.lineno})" if last is not None and known else ""
    return f"{type(error).__name__}: {error}{place}"


def shapes(values: Mapping[str, Any]) -> str:
    """Names with shapes and types: ``states (2, 7) float32, images {top (4, 6, 3) uint8}``."""
    return ", ".join(f"{name} {_shape(value)}" for name, value in values.items())


def _shape(value: Any) -> str:
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{tuple(value.shape)} {str(value.dtype).removeprefix('torch.')}"
    if isinstance(value, Mapping):
        return f"{{{shapes(value)}}}"
    if isinstance(value, (list, tuple)) and value:
        return f"[{len(value)} of {_shape(value[0])}]"
    return f"{value!r:.40}"


def numbers(values: Mapping[str, Any]) -> str:
    """The sizes among arguments: ``state_dim = 14, image_size = (48, 64)``."""
    found = [f"{k} = {v!r}" for k, v in values.items() if type(v) is int or _is_size(v)]
    more = f" and {len(found) - _LISTED} more" if len(found) > _LISTED else ""
    return ", ".join(found[:_LISTED]) + more


def _is_size(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and bool(value) and all(type(n) is int for n in value)


def is_json(value: Any) -> bool:
    """Whether ``value`` is made of JSON values alone, and comes back as it is."""
    try:
        return bool(json.loads(json.dumps(value, allow_nan=False)) == value)
    except (TypeError, ValueError):
        return False


def as_array(value: Any) -> Any:
    """``value`` as an array where it is a tensor or an array; else as it is."""
    if type(value).__module__.startswith("torch"):
        return value.detach().cpu().float().numpy()
    return value


def equal(a: Any, b: Any) -> bool:
    """Whether two values, arrays, tensors, or nested tables and lists of these are equal."""
    if isinstance(a, Mapping):
        same_keys = isinstance(b, Mapping) and set(a) == set(b)
        return same_keys and all(equal(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        same_length = isinstance(b, (list, tuple)) and len(a) == len(b)
        return same_length and all(equal(x, y) for x, y in zip(a, b, strict=True))
    a, b = as_array(a), as_array(b)
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return np.shape(a) == np.shape(b) and np.array_equal(a, b, equal_nan=_floats(a, b))
    return bool(a == b)


def _floats(*arrays: Any) -> bool:
    return all(np.asarray(a).dtype.kind == "f" for a in arrays)


def unequal_keys(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[str]:
    """Keys that one of two tables lacks, or whose values differ."""
    return sorted(k for k in {*a, *b} if k not in a or k not in b or not equal(a[k], b[k]))
