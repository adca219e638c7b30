"""The exceptions of FluxVLA, and the exit code of a command that each ends.

FluxError                     1
├── UsageError                2   the command line asks for something that cannot be
├── ConfigError               2   a config file is missing, unreadable or wrong
├── PluginError               2   a class that a config names cannot be loaded
│   ├── MissingPlugin             nothing installed provides the name
│   ├── AmbiguousPlugin           several distributions provide it
│   ├── IncompatiblePlugin        written for another core
│   └── LoadFailed                its import or its contract fails
├── SpecMismatch              2   dataset, checkpoint, policy and robot disagree
├── DataError                 2   a dataset is missing, damaged or of another version
├── CheckpointError           2   a checkpoint is missing, damaged or of another model
├── RunFailed                 1   work that was under way could not be finished
├── OperatorError             1
│   ├── NotReady                  the robot does not answer yet; trying again may help
│   ├── Rejected                  the robot or the operator refuses the request
│   └── Faulted                   the robot reports a fault
└── SafetyStop                1   a safety rule ended the motion
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import ClassVar, Literal

__all__ = [
    "EXIT_BAD_INPUT",
    "EXIT_DONE",
    "EXIT_FAILED",
    "EXIT_INTERRUPTED",
    "AmbiguousPlugin",
    "CheckpointError",
    "ConfigError",
    "DataError",
    "Faulted",
    "FluxError",
    "IncompatiblePlugin",
    "LoadFailed",
    "MissingPlugin",
    "NotReady",
    "OperatorError",
    "PluginError",
    "Problem",
    "Rejected",
    "RunFailed",
    "SafetyStop",
    "SpecMismatch",
    "UsageError",
]

# Control characters but for tabs and line ends; marks without width and those that turn the
# direction of writing; halves of surrogate pairs, which cannot be encoded.
_STEERING = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\xad\u061c\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff"
    r"\ud800-\udfff\U000e0000-\U000e007f]"
)

_LISTED = 200  # problems of a config
_QUOTED = 100  # characters of a text

EndReason = Literal["stopped", "rank lost", "work dir lost"]

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130


class FluxError(Exception):
    """Base class: a message with what happened, where, the likely cause, and the next command.

    Args:
        what: the problem in one sentence, without a trailing full stop.
        where: ``file:line: dotted.key`` or a path; shown before ``what``.
        cause: the likely cause, if the finding alone does not say it.
        next: the command or change that fixes it or shows more.
    """

    exit_code = EXIT_FAILED
    rule: ClassVar[str] = ""
    """The safety rule that a robot's stop is recorded under, if this error ends its motion."""

    def __init__(
        self,
        what: str,
        *,
        where: str | None = None,
        cause: str | None = None,
        next: str | None = None,
    ) -> None:
        self.what = what
        self.where = where
        self.cause = cause
        self.next = next
        super().__init__(what)

    def __str__(self) -> str:
        lines = [f"{self.where}: {self.what}" if self.where else self.what]
        if self.cause:
            lines.append(f"  likely cause: {self.cause}")
        if self.next:
            lines.append(f"  next: {self.next}")
        return "\n".join(lines)

    def __reduce__(self) -> tuple[object, ...]:
        # Errors cross process borders (evaluation workers); the keywords must survive.
        return (_rebuild, (type(self), self.what, self.where, self.cause, self.next))


def _rebuild(
    cls: type[FluxError], what: str, where: str | None, cause: str | None, next: str | None
) -> FluxError:
    return cls(what, where=where, cause=cause, next=next)


@contextmanager
def located(where: str | None) -> Iterator[None]:
    """Context manager: set ``where`` of errors raised inside that name no place."""
    try:
        yield
    except FluxError as error:
        error.where = error.where or where
        raise


def printable(text: str) -> str:
    """``text`` for a terminal, with control and invisible characters as escapes.

    Names and messages may come from untrusted files.
    """
    return _STEERING.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def quoted(text: str) -> str:
    """``text`` in quotes, for a message; of a long one the beginning."""
    return repr(text if len(text) <= _QUOTED else f"{text[:_QUOTED]}…")


def nearest(name: str, names: Iterable[str], least: float = 0.6) -> str | None:
    """The most similar of ``names``, for a did-you-mean; None if none is close.

    Args:
        least: similarity, from 0 to 1, below which a name is not close.
    """
    import difflib  # most commands have nothing to suggest

    return next(iter(difflib.get_close_matches(name, list(names), 1, least)), None)


@dataclass(frozen=True)
class Problem:
    """One problem of a config; a ``ConfigError`` has all of them.

    ``where`` is ``file:line``, ``key`` the dotted key, ``what`` the problem with its did-you-mean.
    """

    where: str
    key: str
    what: str

    def __str__(self) -> str:
        place = ": ".join(part for part in (self.where, self.key) if part)
        return f"{place}: {self.what}" if place else self.what


class UsageError(FluxError):
    """The command line asks for something that cannot be."""

    exit_code = EXIT_BAD_INPUT


class ConfigError(FluxError):
    """A config is missing, unreadable or wrong. ``problems`` has all problems."""

    exit_code = EXIT_BAD_INPUT
    problems: tuple[Problem, ...] = ()

    @classmethod
    def from_problems(cls, problems: tuple[Problem, ...], next: str | None = None) -> ConfigError:
        """One error that lists all ``problems``, one a line."""
        count = len(problems)
        head = "1 problem in the config" if count == 1 else f"{count} problems in the config"
        listed = [f"  {problem}" for problem in problems[:_LISTED]]
        listed += [f"  and {count - _LISTED} more"] if count > _LISTED else []
        error = cls("\n".join([f"{head}:", *listed]), next=next)
        error.problems = problems
        return error


class PluginError(FluxError):
    """A class that a config or a command names cannot be loaded."""

    exit_code = EXIT_BAD_INPUT


class MissingPlugin(PluginError):
    """Nothing that is installed or registered provides the name."""


class AmbiguousPlugin(PluginError):
    """Several distributions provide the name; ``type='<distribution>:<name>'`` chooses."""


class IncompatiblePlugin(PluginError):
    """The plugin was written for another version of the core or of a contract."""


class LoadFailed(PluginError):
    """The plugin is there, but its import or its contract fails."""


class SpecMismatch(FluxError):
    """Two sides (dataset, checkpoint, policy, robot) describe different embodiments."""

    exit_code = EXIT_BAD_INPUT


class DataError(FluxError):
    """A dataset is missing, empty, of another version, or damaged."""

    exit_code = EXIT_BAD_INPUT


class CheckpointError(FluxError):
    """A checkpoint is missing, damaged, or of another model."""

    exit_code = EXIT_BAD_INPUT


class RunFailed(FluxError):
    """Work that was under way could not be finished (disk full, worker lost).

    Args:
        reason: the cause, where other code acts on it: a request to stop, another process of the
            training that is gone, or a work dir that is.
    """

    def __init__(
        self,
        what: str,
        *,
        where: str | None = None,
        cause: str | None = None,
        next: str | None = None,
        reason: EndReason | None = None,
    ) -> None:
        super().__init__(what, where=where, cause=cause, next=next)
        self.reason = reason

    def __reduce__(self) -> tuple[object, ...]:
        return (*super().__reduce__(), {"reason": self.reason})


class OperatorError(FluxError):
    """The robot or its driver failed."""

    rule: ClassVar[str] = "operator"


class NotReady(OperatorError):
    """The robot does not answer yet; trying again may help."""


class Rejected(OperatorError):
    """The robot or its operator refuses the request (limits, e-stop, credentials)."""


class Faulted(OperatorError):
    """The robot reports a fault, or the connection to it is gone."""


class SafetyStop(FluxError):
    """A safety rule ended the motion; the robot holds its position."""
