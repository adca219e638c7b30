"""``RemotePolicyClient``: queries the policy in the main process, from the control process."""

from __future__ import annotations

import time
from concurrent.futures import Future
from typing import Any

from fluxvla_core.control.chunks import Chunk
from fluxvla_core.control.delays import DelaySource
from fluxvla_core.control.joiners import PreviousChunk
from fluxvla_core.control.policy_client import Answer, PolicyClient
from fluxvla_core.errors import RunFailed
from fluxvla_core.robot.process.inbox import Inbox, RemoteAnswer
from fluxvla_core.robot.process.link import Link
from fluxvla_core.robot.process.messages import Array, Kind, Message, error_of
from fluxvla_core.robot.robot import Robot

# How often a wait for a reply looks for it, and how long one about delays may take.
_POLL_S, _LATE_S = 0.001, 0.1
_LINK = DelaySource(
    "the main process",
    "it runs, but its thread that answers the control process does not",
    "look at what its other threads do",
)


class RemotePolicyClient(PolicyClient):
    """Queries the policy in the main process, for one episode.

    Args:
        link: the control process's end.
        inbox: takes the answers.
        robot: for messages about its calls.
        patience_s: how long the policy's ``reset`` may take.
    """

    def __init__(self, link: Link, inbox: Inbox, robot: Robot, patience_s: float) -> None:
        self._link, self._inbox, self._robot = link, inbox, robot
        self._patience_s = patience_s
        self._queries = 0

    def first_state(self) -> Array:
        # The main process gives the robot its time, and says so if that was not enough.
        return self._request(Kind.FIRST_STATE, None).arrays[0]

    def reset(self) -> None:
        self._request(Kind.RESET, self._patience_s)

    def query(self, previous: PreviousChunk | None) -> Future[Answer]:
        self._queries += 1
        future: Future[Answer] = Future()
        self._inbox.answers[self._queries] = future
        fields, arrays = _previous_fields(previous)
        self._link.send(Kind.QUERY, arrays, number=self._queries, **fields)
        return future

    def accepted(self, answer: Answer) -> None:
        assert isinstance(answer, RemoteAnswer)
        self._link.send(Kind.ACCEPTED, number=answer.number)

    def ticked(self) -> None:
        """Nothing: the main process hears of the command, and looks."""

    def refused(self, answer: Answer) -> None:
        assert isinstance(answer, RemoteAnswer)
        self._link.send(Kind.REFUSED, number=answer.number)

    def slowest_since(self, since: float) -> tuple[DelaySource, float]:
        own = self._robot.delays.longest(since)
        self._link.try_send(Kind.LATE, since=since)
        until = time.monotonic() + _LATE_S
        while Kind.LATE not in self._inbox.replies and time.monotonic() < until:
            self._inbox.poll()
            time.sleep(_POLL_S)
        reply = self._inbox.replies.pop(Kind.LATE, None)
        if reply is None:
            return _LINK, time.monotonic() - since
        if reply["seconds"] < own[1]:
            return own
        return DelaySource(reply["name"], reply["cause"], reply["next"]), reply["seconds"]

    def _request(self, what: Kind, patience_s: float | None) -> Message:
        """Ask the main process while nothing moves; its reply."""
        began = time.monotonic()
        self._link.send(what)
        while (reply := self._inbox.replies.pop(what, None)) is None:
            self._inbox.check()
            if patience_s is not None and time.monotonic() - began > patience_s:
                raise RunFailed(f"the policy's {what.value} did not return within {patience_s:g} s")
            if self.meanwhile is None:
                time.sleep(_POLL_S)
            else:
                self.meanwhile()
        if "error" in reply.fields:
            raise error_of(reply.fields)
        return reply


def _previous_fields(previous: PreviousChunk | None) -> tuple[dict[str, Any], tuple[Array, ...]]:
    if previous is None:
        return {}, ()
    fields = {
        "rate_hz": previous.chunk.rate_hz,
        "observed": previous.chunk.observed,
        "latency_s": previous.latency_s,
        "schedule": previous.schedule,
        "max_guidance_weight": previous.max_guidance_weight,
    }
    return fields, (previous.chunk.actions, previous.chunk.anchor)


def previous_chunk_of(message: Message) -> PreviousChunk | None:
    """The chunk in a message ``QUERY``, which the policy has to continue."""
    if not message.arrays:
        return None
    actions, anchor = message.arrays
    fields = message.fields
    return PreviousChunk(
        Chunk(actions, fields["rate_hz"], fields["observed"], anchor),
        fields["latency_s"],
        fields["schedule"],
        fields["max_guidance_weight"],
    )
