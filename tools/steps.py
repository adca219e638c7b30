"""Run the parts of a session one after the other, and list those that failed at the end."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

from tools.shell import StepFailed


class Steps:
    """Runs the parts of a session; a failing part does not keep the next one from running.

        with Steps(session) as step:
            step("lint", check_lint)

    Args:
        session: nox's, or anything with its ``log``, ``warn`` and ``error``; the latter raises.
    """

    def __init__(self, session: Any) -> None:
        self._session = session
        self._failed: list[str] = []
        self._took: list[str] = []

    def __enter__(self) -> Steps:
        return self

    def __call__(self, name: str, action: Callable[[], object]) -> None:
        """Run one part; its StepFailed is printed, and fails the session at its end."""
        self._session.log(f"== {name}")
        began = time.monotonic()
        try:
            action()
        except StepFailed as error:
            self._session.warn(f"{name}: {error}")
            self._failed.append(name)
        self._took.append(f"{name} {time.monotonic() - began:.0f} s")

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if isinstance(error, StepFailed):  # outside a part: without its environment none can run
            self._session.error(str(error))
        if kind is None:
            self._session.log(f"took: {', '.join(self._took)}")
            if self._failed:
                self._session.error(f"failed: {', '.join(self._failed)}")
