"""Explicit contract checks, made when a class is loaded.

``isinstance`` accepts a method with the wrong arguments and an attribute that is not a method at
all; here every method of the contract's base class must be there, be callable, and take what the
core will pass. That follows from the base class itself: its abstract and its optional methods, and
their signatures.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import math
from collections.abc import Mapping
from inspect import Parameter
from typing import Any, SupportsFloat, SupportsIndex, cast

from fluxvla_core.contracts.contract import (
    Contract,
    abstract_methods,
    implements,
    public_methods,
)
from fluxvla_core.contracts.policy import Actor
from fluxvla_core.contracts.robot import Operator
from fluxvla_core.contracts.runner import TrainRunner
from fluxvla_core.contracts.training import RandomTransform
from fluxvla_core.errors import LoadFailed
from fluxvla_core.registries import BY_NAME, check_api
from fluxvla_core.spec import EmbodimentSpec

Arguments = int | tuple[str, ...] | None
"""Arguments of a call, without ``self``: a number of positional ones, keywords of these names, or
(None) those that the class itself names."""

Methods = Mapping[str, Arguments]

ANY_OTHER = "any other"
"""No name that a parameter can have: only ``**more`` takes it."""
ON_A_ROBOT = ("embodiment", "action_rate_hz", "horizon")
"""Attributes that a policy needs to drive a robot."""
_MISSING = "is missing"


@functools.cache
def contract_of(registry: str) -> type[Contract]:
    """The base class of ``registry``; ``Contract``, which requires nothing, if it has none."""
    module, _, name = (BY_NAME[registry].contract or "").partition(":")
    if not module:
        return Contract
    return cast("type[Contract]", getattr(importlib.import_module(module), name))


def needs(contract: type[Contract], cls: type) -> tuple[Methods, ...]:
    """Alternative sets of methods: ``cls`` must have all methods of one set."""
    abstract = abstract_methods(contract)
    sets = (abstract,) if abstract and issubclass(cls, contract) else contract._enough(cls)
    every = methods(contract)
    return tuple({name: every.get(name) for name in names} for names in sets)


def methods(contract: type[Contract]) -> Methods:
    """Every method of ``contract``, required and optional, with its arguments."""
    found = {name: _arguments(contract, f) for name, f in public_methods(contract).items()}
    return {**found, **contract._besides}


def _arguments(contract: type[Contract], function: Any) -> Arguments:
    if contract._any_arguments:
        return None
    taken = list(inspect.signature(function).parameters.values())[1:]
    keywords = [p.name for p in taken if p.kind is Parameter.KEYWORD_ONLY]
    if keywords:
        more = any(p.kind is Parameter.VAR_KEYWORD for p in taken)
        return (*keywords, ANY_OTHER) if more else tuple(keywords)
    if [p.kind for p in taken] == [Parameter.VAR_KEYWORD]:
        return None  # such as ``VLA.observe``: the class chooses
    return len(taken)


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
    check_api(registry, name, getattr(cls, "api", None), origin)
    contract = _contract_for(registry, cls)
    problems = [] if registry != "vlas" or _is_module(cls) else ["it is not a torch.nn.Module"]
    problems += _problems(contract, cls, needs(contract, cls))
    named = {m: n for m, n in methods(contract).items() if not m.startswith("__")}
    problems += _wrong(
        contract, cls, {m: n for m, n in named.items() if _lookup(contract, cls, m) is not None}
    )
    problems += _incomplete_groups(contract, cls)
    if problems:
        raise LoadFailed(
            f"{origin}: {name} does not fulfil the contract of fluxvla.{registry}: "
            + "; ".join(dict.fromkeys(problems)),
            next="see docs/writing-a-plugin.md for what each contract asks for",
        )


def _incomplete_groups(contract: type[Contract], cls: type) -> list[str]:
    """Problems with groups of methods that ``cls`` has only in part."""
    problems = []
    for group in contract._together:
        there = [f"{m}()" for m in group if _lookup(contract, cls, m) is not None]
        lacks = [f"{m}()" for m in group if f"{m}()" not in there]
        if there and lacks:
            problems.append(
                f"it has {' and '.join(there)} but no {' and '.join(lacks)}; "
                "these are needed together, or not at all"
            )
    return problems


def _contract_for(registry: str, cls: type) -> type[Contract]:
    if registry == "runners" and is_train_runner(cls):
        return TrainRunner
    if registry == "transforms" and getattr(cls, "needs_rng", False):
        return RandomTransform
    return contract_of(registry)


def _problems(contract: type[Contract], cls: type, sets: tuple[Methods, ...]) -> list[str]:
    """The problems of ``cls`` with the nearest of ``sets``; empty if it has one of them."""
    tried = [_wrong(contract, cls, one) for one in sets]
    if not all(tried):
        return []
    if len(sets) == 1:
        return tried[0]
    choice = ", or ".join(" and ".join(f"{method}()" for method in one) for one in sets)
    there = [text for texts in tried for text in texts if not text.endswith(_MISSING)]
    return [f"it needs {choice}", *there]


def _wrong(contract: type[Contract], cls: type, named: Methods) -> list[str]:
    return [text for m, n in named.items() if (text := _method_problem(contract, cls, m, n))]


def _is_module(cls: type) -> bool:
    """Whether ``cls`` is a ``torch.nn.Module``, by its bases' names: torch is not imported."""
    return any(
        f"{c.__module__}.{c.__name__}" == "torch.nn.modules.module.Module" for c in cls.__mro__
    )


def is_train_runner(cls: type) -> bool:
    """Whether ``run_setup`` takes ``n_train_examples``, as a train runner's does."""
    method = getattr(cls, "run_setup", None)
    if not callable(method):
        return False
    return "n_train_examples" in inspect.signature(method).parameters


def missing_operator_methods(operator: object) -> list[str]:
    """Methods of the full contract that ``operator``, written for upstream FluxVLA, lacks."""
    cls = type(operator)
    full = {m: n for m, n in methods(Operator).items() if m in abstract_methods(Operator)}
    lacks = [f"{m}()" for m, n in full.items() if _method_problem(Operator, cls, m, n)]
    if not hasattr(operator, "embodiment"):
        lacks.insert(0, "embodiment")
    return lacks


def check_operator(operator: object) -> None:
    """Check an operator that was built: its class, and that its own attributes hide no method.

    A constructor that says ``self.stop = threading.Event()`` takes the robot its ``stop()``.

    Raises:
        LoadFailed, IncompatiblePlugin: see ``check_class``.
    """
    cls = type(operator)
    check_class("operators", cls, f"{cls.__module__}:{cls.__qualname__}")
    own = getattr(operator, "__dict__", {})
    named = [m for m in methods(Operator) if m in own]
    hidden = [f"{m} is a {type(own[m]).__name__}" for m in named if not callable(own[m])]
    if hidden:
        raise LoadFailed(
            f"the constructor of {cls.__name__} hides methods of its class: {', '.join(hidden)}",
            next="give the attribute another name",
        )


def check_policy(policy: Any) -> None:
    """Check that a policy has the attributes that driving a robot needs.

    Raises:
        LoadFailed: it has no ``embodiment``, ``action_rate_hz`` or ``horizon``, or one that cannot
            be; or its ``cameras`` are not names.
    """
    said = [n for n in ON_A_ROBOT if hasattr(policy, n) and implements(policy, Actor, n)]
    lacks = [name for name in ON_A_ROBOT if name not in said]
    name = type(policy).__name__
    if lacks:
        raise LoadFailed(
            f"{name} cannot drive a robot: it has no {', '.join(lacks)}",
            cause="it is for evaluations, whose environments say what it does not",
            next="choose another policy, or see docs/writing-a-plugin.md for what one has",
        )
    problems = chunk_problems(policy.action_rate_hz, policy.horizon)
    if not isinstance(policy.embodiment, EmbodimentSpec):
        problems.append(f"embodiment is a {type(policy.embodiment).__name__}, no EmbodimentSpec")
    cameras = getattr(policy, "cameras", ())
    if not isinstance(cameras, (tuple, list)) or not all(isinstance(c, str) for c in cameras):
        problems.append(f"cameras is {cameras!r}, and no tuple of names")
    if problems:
        raise LoadFailed(f"{name} cannot drive a robot: {'; '.join(problems)}")


def chunk_problems(action_rate_hz: object, horizon: object) -> list[str]:
    """Problems of chunks of so many actions at this rate, in words."""
    problems = []
    rate = action_rate_hz if isinstance(action_rate_hz, SupportsFloat) else math.nan
    if isinstance(action_rate_hz, (bool, str)) or not 0.0 < float(rate) < math.inf:
        problems.append(f"action_rate_hz is {action_rate_hz!r}; it must be positive and finite")
    if isinstance(horizon, bool) or not isinstance(horizon, SupportsIndex) or int(horizon) < 1:
        problems.append(f"horizon is {horizon!r}; it must be a whole number of at least 1")
    return problems


def _lookup(contract: type[Contract], cls: type, method: str) -> Any:
    """The attribute ``method`` of ``cls`` or a base, without binding it; None if there is none.

    Attributes of its metaclass do not count: every class is callable, and its objects need not be.
    Nor do those of the contract, which are defaults or abstract.
    """
    bases = [base for base in cls.__mro__ if base not in contract.__mro__]
    found = next((vars(base)[method] for base in bases if method in vars(base)), None)
    # torch.nn.Module's placeholder for a missing forward.
    return None if getattr(found, "__name__", "") == "_forward_unimplemented" else found


def _method_problem(
    contract: type[Contract], cls: type, method: str, arguments: Arguments
) -> str | None:
    found = _lookup(contract, cls, method)
    if found is None:
        return f"{method}() {_MISSING}"
    bound: list[object] = [] if isinstance(found, staticmethod) else [cls]
    function = found.__func__ if isinstance(found, (staticmethod, classmethod)) else found
    if not callable(function):
        return f"{method} is a {type(function).__name__}, not a method"
    if inspect.iscoroutinefunction(function) or inspect.isasyncgenfunction(function):
        return f"{method}() is async, and nobody awaits it: called, it does nothing"
    if getattr(function, "__isabstractmethod__", False):
        return f"{method}() is abstract"
    if arguments is None:
        return None
    names = arguments if isinstance(arguments, tuple) else ()
    bound += [None] * (arguments if isinstance(arguments, int) else 0)
    try:
        inspect.signature(function).bind(*bound, **dict.fromkeys(names))
    except TypeError as error:
        return f"{method}() must accept {_in_words(arguments)}: {error}"
    except ValueError:  # written in C, without a signature
        return None
    return None


def _in_words(arguments: int | tuple[str, ...]) -> str:
    if isinstance(arguments, tuple):
        return f"the keyword{'s' if len(arguments) > 1 else ''} {', '.join(arguments)}"
    if arguments == 0:
        return "no argument"
    return f"{arguments} argument{'s' if arguments > 1 else ''}"
