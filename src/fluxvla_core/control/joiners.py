"""The ways to join chunks, by the names that a config's ``chunk_joining`` knows."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Mapping
from typing import Any

from fluxvla_core.control.blending import Overlap, TemporalEnsemble
from fluxvla_core.control.joining import Joiner, LatestOnly, Streamed, Synchronous
from fluxvla_core.control.real_time import RealTime
from fluxvla_core.errors import ConfigError

STREAMED: Mapping[str, type[Streamed]] = {
    "latest_only": LatestOnly,
    "temporal_ensemble": TemporalEnsemble,
    "overlap": Overlap,
    "rtc": RealTime,
}
METHODS = ("synchronous", *STREAMED)


def make_joiner(value: str | Mapping[str, Any] | None, every_s: float = 0.0) -> Joiner:
    """The joiner that a config asks for.

    Args:
        value: a name of ``METHODS``, or a table with ``method = '<name>'`` and the parameters of
            its class; None means ``synchronous``.
        every_s: how far apart observations should be, for those that ask while they play.

    Raises:
        ConfigError: an unknown method or parameter (with the nearest one), or a bad value.
    """
    options = dict(value) if isinstance(value, Mapping) else {"method": value or "synchronous"}
    method = options.pop("method", None)
    if method not in METHODS:
        raise ConfigError(f"method {method!r}{_hint(method, METHODS)}")
    kind: Any = STREAMED.get(str(method), Synchronous)
    taken = [name for name in inspect.signature(kind).parameters if name != "every_s"]
    for name in options:
        if name not in taken:
            raise ConfigError(f"{method} takes no {name!r}{_hint(name, taken)}")
    if kind is Synchronous:
        return Synchronous()
    try:
        joiner: Joiner = kind(every_s=every_s, **options)
    except TypeError as error:
        raise ConfigError(f"{method}: {error}") from error
    except ConfigError as error:
        raise ConfigError(f"{method}: {error.what}") from error
    return joiner


def _hint(name: Any, known: tuple[str, ...] | list[str]) -> str:
    near = difflib.get_close_matches(str(name), known, 1)
    if near:
        return f"; did you mean {near[0]!r}?"
    return f"; there are {', '.join(known)}" if known else "; it takes nothing"
