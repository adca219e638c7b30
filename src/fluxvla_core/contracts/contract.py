"""Base class of all contracts, and the adapter for classes that do not inherit one.

A contract is a base class. Its abstract methods are required; everything else has a working
default. A class may inherit it, or only have its methods: ``Contract.adapt`` supplies the defaults,
so that code that calls an operator, a policy or a filter never tests for a method.
"""

from __future__ import annotations

import inspect
from abc import ABCMeta
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, cast

C = TypeVar("C", bound="Contract")
_NOTHING = object()


if TYPE_CHECKING:
    from abc import abstractproperty as required
    from builtins import property as attribute
else:

    class attribute:
        """A property with a default; a class may define it, or a constructor set it."""

        def __init__(self, function):
            self.__doc__ = function.__doc__
            self._function = function

        def __get__(self, made, owner=None):
            # Without ``__set__``, so that a value set by a constructor comes first.
            return self if made is None else self._function(made)

    class required(attribute):
        """An attribute that has no default."""

        def __set_name__(self, owner, name):
            self._name = name

        def __get__(self, made, owner=None):
            raise AttributeError(f"{(owner or type(made)).__name__} has no {self._name}")


__all__ = [
    "Contract",
    "abstract_methods",
    "attribute",
    "implements",
    "original",
    "public_methods",
    "required",
]


# Not ``ABC`` as base: FSDP gives a model another class, whose layout must be the same.
class Contract(metaclass=ABCMeta):
    """Base of all contracts.

    ``api``, for example ``"1.0"``, says for which version of its contract a class was written.
    """

    api: ClassVar[str]
    _besides: ClassVar[Mapping[str, int]] = {}
    """Methods that some classes have instead -> number of their arguments."""
    _together: ClassVar[tuple[tuple[str, ...], ...]] = ()
    """Groups of optional methods; a class defines all of a group or none."""
    _any_arguments: ClassVar[bool] = False
    """Whether a class chooses which of the arguments its methods take."""

    @classmethod
    def _enough(cls, candidate: type) -> tuple[tuple[str, ...], ...]:
        """Sets of methods; a ``candidate`` without the base class needs all methods of one set."""
        return (abstract_methods(cls),)

    @classmethod
    def adapt(cls: type[C], made: Any) -> C:
        """``made`` as an object of this contract: itself, or an adapter that delegates to it.

        The adapter has the contract's defaults for everything that ``made`` lacks. An abstract
        method's default does nothing; :func:`implements` distinguishes it from the class's own.
        """
        if isinstance(made, cls):
            return made
        made = original(made)
        body = {name: _delegating(name) for name in public_methods(cls) if name.startswith("__")}
        kind = type(type(made).__name__, (_Adapter, cls), {**body, "__module__": __name__})
        setattr(kind, "__abstractmethods__", frozenset())  # noqa: B010 - unknown to type checkers
        return cast(C, kind(made, cls))


def public_methods(contract: type[Contract]) -> dict[str, Any]:
    """The functions of ``contract`` by name, in the order of their definition."""
    found: dict[str, Any] = {}
    for base in reversed(contract.__mro__):
        if issubclass(base, Contract):
            found |= {n: f for n, f in vars(base).items() if inspect.isfunction(f) and _public(n)}
    return found


def abstract_methods(contract: type[Contract]) -> tuple[str, ...]:
    """Names of the methods that a subclass must define, in the order of their definition."""
    return tuple(n for n in public_methods(contract) if n in contract.__abstractmethods__)


def _public(name: str) -> bool:
    return not name.startswith("_") or (name.startswith("__") and name != "__init__")


def original(made: Any) -> Any:
    """The object that ``adapt`` was given; ``made`` itself if it is not adapted."""
    return object.__getattribute__(made, "_made") if issubclass(type(made), _Adapter) else made


def implements(candidate: Any, contract: type[Contract], ability: str) -> bool:
    """Whether ``candidate`` itself defines the optional ``ability``.

    A property is not evaluated, as it may raise.
    """
    candidate = original(candidate)
    attribute = inspect.getattr_static(candidate, ability, _NOTHING)
    if attribute is _NOTHING:  # unless the object answers for another one
        return hasattr(type(candidate), "__getattr__") and hasattr(candidate, ability)
    default = inspect.getattr_static(contract, ability, _NOTHING)
    # ``stop = None`` in a class says that it has no such method.
    return attribute is not default and not (attribute is None and inspect.isfunction(default))


class _Adapter:
    """Delegates to the adapted object; has the contract's defaults for everything it lacks."""

    def __init__(self, made: Any, contract: type[Contract]) -> None:
        names = {n for base in contract.__mro__ for n in vars(base) if base is not object}
        lacks = frozenset(n for n in names if _public(n) and not implements(made, contract, n))
        object.__setattr__(self, "_made", made)
        object.__setattr__(self, "_contract", contract)
        object.__setattr__(self, "_lacks", lacks)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Pickle the adapted object, for data workers: the adapter's class is local to this one."""
        return object.__getattribute__(self, "_contract").adapt, (original(self),)

    def __getattribute__(self, name: str) -> Any:
        if name == "__reduce_ex__":
            return object.__getattribute__(self, name)
        made = object.__getattribute__(self, "_made")
        lacks = name in object.__getattribute__(self, "_lacks")
        # An object may set a missing attribute later.
        if lacks and getattr(made, "__dict__", {}).get(name) is None:
            return object.__getattribute__(self, name)
        return getattr(made, name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(object.__getattribute__(self, "_made"), name, value)

    def __repr__(self) -> str:
        return repr(object.__getattribute__(self, "_made"))


def _delegating(name: str) -> Any:
    def call(self: Any, *arguments: Any, **keywords: Any) -> Any:
        return getattr(original(self), name)(*arguments, **keywords)

    call.__name__ = name
    return call
