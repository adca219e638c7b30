"""Explicit contract checks, made when a class is loaded.

``isinstance`` on a runtime protocol accepts a method with the wrong arguments and an attribute
that is no method at all; here every method must be there, be callable, and take what the core
will pass.
"""

from __future__ import annotations

import inspect
from typing import Any

from fluxvla_core.contracts.methods import (
    FULL_OPERATOR,
    MAY_HAVE,
    NEEDS,
    RANDOM_TRANSFORM,
    TRAIN_RUNNER,
    Arguments,
    Methods,
)
from fluxvla_core.contracts.protocols import API
from fluxvla_core.errors import IncompatiblePlugin, LoadFailed

_MISSING = "is missing"


def check_class(registry: str, cls: Any, origin: str) -> None:
    """Check that ``cls`` can serve in ``registry``.

    Raises:
        LoadFailed: not a class, or a method is missing, no method, or takes other arguments.
        IncompatiblePlugin: written for another version of the contract.
    """
    name = getattr(cls, "__name__", repr(cls))
    if not inspect.isclass(cls):
        raise LoadFailed(
            f"{origin}: {name} in fluxvla.{registry} is a {type(cls).__name__}, not a class"
        )
    check_api(registry, cls, origin)
    problems = [] if registry != "vlas" or _is_module(cls) else ["it is no torch.nn.Module"]
    problems += _problems(cls, _needs(registry, cls))
    besides = MAY_HAVE.get(registry, {})
    problems += _wrong(cls, {m: n for m, n in besides.items() if _lookup(cls, m) is not None})
    if problems:
        raise LoadFailed(
            f"{origin}: {name} does not fulfil the contract of fluxvla.{registry}: "
            + "; ".join(dict.fromkeys(problems)),
            next="see docs/writing-a-plugin.md for what each contract asks for",
        )


def _needs(registry: str, cls: type) -> tuple[Methods, ...]:
    if registry == "runners" and is_train_runner(cls):
        return (TRAIN_RUNNER,)
    if registry == "transforms" and getattr(cls, "needs_rng", False):
        return (RANDOM_TRANSFORM,)
    return NEEDS.get(registry, ({},))


def _problems(cls: type, sets: tuple[Methods, ...]) -> list[str]:
    """What keeps ``cls`` from having one of ``sets``; nothing if it has one."""
    tried = [_wrong(cls, one) for one in sets]
    if not all(tried):
        return []
    if len(sets) == 1:
        return tried[0]
    choice = ", or ".join(" and ".join(f"{method}()" for method in one) for one in sets)
    there = [text for texts in tried for text in texts if not text.endswith(_MISSING)]
    return [f"it needs {choice}", *there]


def _wrong(cls: type, methods: Methods) -> list[str]:
    return [text for m, n in methods.items() if (text := _method_problem(cls, m, n))]


def _is_module(cls: type) -> bool:
    """Whether ``cls`` is a ``torch.nn.Module``, told without importing torch."""
    return any(
        f"{c.__module__}.{c.__name__}" == "torch.nn.modules.module.Module" for c in cls.__mro__
    )


def check_api(registry: str, cls: type, origin: str) -> None:
    """Caret check of a class's ``api`` against the core's; a class without one is taken as is.

    Raises:
        IncompatiblePlugin: too old or too new, with the upgrade that mends it.
    """
    speaks = API.get(registry)
    written = getattr(cls, "api", None)
    if speaks is None or written is None:
        return
    have, want = _version(speaks), _version(str(written))
    if want is None or have is None:
        raise IncompatiblePlugin(f"{origin}: {cls.__name__}.api = {written!r} is no version")
    if want == have or (want[0] == have[0] and want[1] <= have[1] and have[0] > 0):
        return
    dist = origin.partition(" ")[0]
    upgrade = "fluxvla-core" if want > have else dist
    raise IncompatiblePlugin(
        f"{origin}: {cls.__name__} is written for {registry} {written}, this core speaks {speaks}",
        next=f"pip install --upgrade {upgrade}",
    )


def is_train_runner(cls: type) -> bool:
    """Whether ``run_setup`` takes ``n_train_examples``, as a train runner's does."""
    method = getattr(cls, "run_setup", None)
    if not callable(method):
        return False
    return "n_train_examples" in inspect.signature(method).parameters


def missing_operator_methods(operator: object) -> list[str]:
    """What an operator of the specification's shape lacks of the full contract."""
    cls = type(operator)
    lacks = [f"{m}()" for m, n in FULL_OPERATOR.items() if _method_problem(cls, m, n)]
    if not hasattr(operator, "embodiment"):
        lacks.insert(0, "embodiment")
    return lacks


def _lookup(cls: type, method: str) -> Any:
    """What ``cls`` or a base defines as ``method``, as it stands there; None if nothing.

    Not what its metaclass has: every class is callable, and its objects need not be.
    """
    found = next((vars(base)[method] for base in cls.__mro__ if method in vars(base)), None)
    # Stands in torch.nn.Module for the forward that a subclass is to bring.
    return None if getattr(found, "__name__", "") == "_forward_unimplemented" else found


def _method_problem(cls: type, method: str, arguments: Arguments) -> str | None:
    found = _lookup(cls, method)
    if found is None:
        return f"{method}() {_MISSING}"
    bound: list[object] = [] if isinstance(found, staticmethod) else [cls]
    function = found.__func__ if isinstance(found, (staticmethod, classmethod)) else found
    if not callable(function):
        return f"{method} is a {type(function).__name__}, not a method"
    if arguments is None:
        return None
    names = arguments if isinstance(arguments, tuple) else ()
    bound += [None] * (arguments if isinstance(arguments, int) else 0)
    try:
        inspect.signature(function).bind(*bound, **dict.fromkeys(names))
    except TypeError as error:
        return f"{method}() must accept {_told(arguments)}: {error}"
    except ValueError:  # written in C, where not every function says what it takes
        return None
    return None


def _told(arguments: int | tuple[str, ...]) -> str:
    if isinstance(arguments, tuple):
        return f"the keyword{'s' if len(arguments) > 1 else ''} {', '.join(arguments)}"
    if arguments == 0:
        return "no argument"
    return f"{arguments} argument{'s' if arguments > 1 else ''}"


def _version(text: str) -> tuple[int, int] | None:
    major, _, minor = text.partition(".")
    if not (major.isdigit() and (minor or "0").isdigit()):
        return None
    return int(major), int(minor or 0)
