"""Explicit contract checks, made when a class is loaded.

``isinstance`` on a runtime protocol accepts a method with the wrong arguments and an attribute
that is no method at all; here every method must be there, be callable, and take what the core
will pass.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

from fluxvla_core.contracts.protocols import API
from fluxvla_core.errors import IncompatiblePlugin, LoadFailed

# registry -> method -> number of positional arguments that the core passes (without self).
# An operator of the specification's shape has get_frame and commands of its own; what it lacks
# is asked for when it is built, where the config can supply an embodiment.
_METHODS: Mapping[str, Mapping[str, int]] = {
    "operators": {"get_frame": 0},
    "runners": {"run": 0, "run_setup": 0},
    "transforms": {"__call__": 1},
    "collators": {"__call__": 1},
    "optimizers": {"build": 2},
    "datasets": {},
    "environments": {"reset": 2, "step": 1, "observe": 1, "close": 0},
    "policies": {"reset": 1, "predict_action": 1},
    "commands": {"add_arguments": 1, "run": 1},
    "action_filters": {"__call__": 1},
}
# What a class may have besides (contracts.optional); checked where it is there.
_OPTIONAL: Mapping[str, Mapping[str, int]] = {
    "operators": {
        "get_state": 0,
        "state_stamp": 0,
        "task_done": 0,
        "task_success": 0,
        "begin_episode": 2,
        "pictures_after": 2,
    },
    "policies": {"continue_action": 2},
    "action_filters": {"bind": 1, "reset": 1},
}
_FULL_OPERATOR = {"connect": 0, "get_frame": 0, "send_action": 1, "stop": 0, "close": 0}


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
    wanted = dict(_METHODS.get(registry, {}))
    if registry == "runners" and is_train_runner(cls):
        wanted = {"run": 1, "run_setup": 1}
    if registry == "transforms" and getattr(cls, "needs_rng", False):
        wanted = {"__call__": 2}
    optional = _OPTIONAL.get(registry, {})
    wanted |= {method: count for method, count in optional.items() if hasattr(cls, method)}
    problems = [p for m, n in wanted.items() if (p := _method_problem(cls, m, n))]
    if problems:
        raise LoadFailed(
            f"{origin}: {name} does not fulfil the contract of fluxvla.{registry}: "
            + "; ".join(problems),
            next="see docs/writing-a-plugin.md for what each contract asks for",
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
    lacks = [f"{m}()" for m, n in _FULL_OPERATOR.items() if _method_problem(cls, m, n)]
    if not hasattr(operator, "embodiment"):
        lacks.insert(0, "embodiment")
    return lacks


def _method_problem(cls: type, method: str, count: int) -> str | None:
    function = inspect.getattr_static(cls, method, None)
    if function is None:
        return f"{method}() is missing"
    if isinstance(function, (staticmethod, classmethod)):
        bound = [object()] * count
        function = function.__func__
        bound = (
            bound
            if isinstance(inspect.getattr_static(cls, method), staticmethod)
            else [*bound, cls]
        )
    else:
        bound = [object()] * (count + 1)
    if not callable(function):
        return f"{method} is a {type(function).__name__}, not a method"
    try:
        inspect.signature(function).bind(*bound)
    except TypeError as error:
        what = "no argument" if count == 0 else f"{count} argument{'s' if count > 1 else ''}"
        return f"{method}() must accept {what}: {error}"
    return None


def _version(text: str) -> tuple[int, int] | None:
    major, _, minor = text.partition(".")
    if not (major.isdigit() and (minor or "0").isdigit()):
        return None
    return int(major), int(minor or 0)
