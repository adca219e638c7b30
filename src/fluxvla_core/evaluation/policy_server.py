"""Batched inference: one policy on one device for the episodes of all worker processes.

Workers simulate and send requests; a thread of the parent answers them in batches of a fixed,
padded size. A batch is made of the requests that wait when the device becomes free, so that no
worker waits for the slowest. Because every forward pass has the same shape, and a row's noise
follows from the episode's seed and the number of its call, an answer does not depend on the other
rows of its batch; that a model and device keep to this bit for bit is checked before the first
episode.
"""

from __future__ import annotations

import queue
import threading
import traceback
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import Observation
from fluxvla_core.contracts.policy import Continuation, Policy, with_history
from fluxvla_core.errors import EXIT_BAD_INPUT, ConfigError, FluxError, RunFailed
from fluxvla_core.policies.local import LocalPolicy, Query
from fluxvla_core.spec import EmbodimentSpec

Array = npt.NDArray[np.float64]
Load = Callable[[], LocalPolicy]
_Answer = tuple[str, Any]


@dataclass(frozen=True)
class PolicyFacts:
    """The attributes of a served policy, for the worker's side of it."""

    embodiment: EmbodimentSpec
    cameras: tuple[str, ...]
    action_rate_hz: float
    horizon: int
    continues: bool = False
    n_obs_steps: int = 1


@dataclass(frozen=True)
class _Request:
    connection: Connection
    name: str
    query: Query

    @property
    def kind(self) -> tuple[str, bool]:
        """Key of the requests that may share a batch: the policy, and whether they continue a
        chunk."""
        return self.name, self.query.rest is None


class PolicyServer:
    """Serves policies until it is closed; use as a context manager.

    Args:
        policies: name -> loader, called in the thread that answers.
        threads: processor threads of a policy on the CPU. One, as in worker processes, keeps
            answers equal to theirs.

    Attributes:
        facts: name -> the policy's attributes; complete when the constructor returns.
        batches, rows: how many forward passes there were, and how many requests they answered.

    Raises:
        FluxError: what a loader raised.
        ConfigError: a row's answer depends on the other rows.
    """

    def __init__(self, policies: Mapping[str, Load], threads: int = 1) -> None:
        self.facts: dict[str, PolicyFacts] = {}
        self.batches = self.rows = 0
        self._loaders = dict(policies)
        self._policies: dict[str, LocalPolicy] = {}
        self._threads = threads
        self._new: queue.SimpleQueue[Connection | None] = queue.SimpleQueue()
        self._awake, self._wake = get_context("spawn").Pipe(duplex=False)
        self._started: queue.SimpleQueue[BaseException | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="fluxvla-policies", daemon=True)
        self._thread.start()
        problem = self._started.get()
        if problem is not None:
            self._thread.join()
            raise problem

    def link(self) -> Connection:
        """A worker's end of a connection of its own; to be closed here once it has it.

        Raises:
            RunFailed: the thread with the policy has ended.
        """
        if not self._thread.is_alive():
            raise RunFailed("the thread with the policy has ended")
        ours, theirs = get_context("spawn").Pipe()
        self._new.put(ours)
        self._wake.send_bytes(b"n")
        return theirs

    def close(self) -> None:
        """Stop answering; any number of times."""
        if self._thread.is_alive():
            self._new.put(None)
            self._wake.send_bytes(b"n")
            self._thread.join()

    def __enter__(self) -> PolicyServer:
        return self

    def __exit__(self, *details: object) -> None:
        self.close()

    def _run(self) -> None:
        try:
            import torch

            torch.set_num_threads(self._threads)
            for name, load in self._loaders.items():
                policy = load()
                check_rows(policy)
                self._policies[name] = policy
                names = [field.name for field in fields(PolicyFacts)]
                self.facts[name] = PolicyFacts(**{key: getattr(policy, key) for key in names})
        except BaseException as error:  # noqa: BLE001 - it is raised where the server is made
            self._started.put(error)
            return
        self._started.put(None)
        connections: list[Connection] = []
        try:
            self._answer_all(connections)
        finally:  # whatever ends this: no worker waits for an answer that will not come
            for connection in connections:
                connection.close()

    def _answer_all(self, connections: list[Connection]) -> None:
        waiting: deque[_Request] = deque()
        while True:
            # With requests waiting only look, else sleep.
            ready = wait([self._awake, *connections], timeout=0 if waiting else None)
            for connection in ready:
                if connection is self._awake:
                    self._awake.recv_bytes()
                    new = self._new.get()
                    if new is None:
                        return
                    connections.append(new)
                    continue
                assert isinstance(connection, Connection)
                try:
                    name, query = connection.recv()
                    waiting.append(_Request(connection, name, query))
                except (EOFError, OSError):  # the worker is gone
                    connections.remove(connection)
                    connection.close()
            if waiting:
                self._answer_some(waiting)

    def _answer_some(self, waiting: deque[_Request]) -> None:
        """One forward pass for the oldest request and those that fit into its batch."""
        oldest = waiting[0]
        policy = self._policies[oldest.name]
        alike = [request for request in waiting if request.kind == oldest.kind]
        batch = alike[: policy.batch_size]
        for request in batch:
            waiting.remove(request)
        answers = self._answers(policy, [request.query for request in batch])
        self.rows += len(batch)
        for request, answer in zip(batch, answers, strict=True):
            try:
                request.connection.send(answer)
            except OSError:  # the worker is gone; reading its connection will show it
                continue

    def _answers(self, policy: LocalPolicy, queries: Sequence[Query]) -> list[_Answer]:
        """The answer to each query.

        If a batch fails each query is answered alone: one that cannot be answered must not end
        the episodes of the others.
        """
        self.batches += 1
        try:
            return [("chunk", chunk) for chunk in policy.predict_batch(queries)]
        except Exception as error:  # noqa: BLE001 - an episode's crash is counted, not raised
            if len(queries) == 1:
                return [_failure(error)]
        return [self._answers(policy, [query])[0] for query in queries]


def _failure(error: Exception) -> _Answer:
    if not isinstance(error, FluxError):
        return "raised", "".join(traceback.format_exception(error))
    if error.exit_code == EXIT_BAD_INPUT:
        return "refused", error
    return "raised", str(error)


class ServedPolicy(Policy):
    """The worker's side: a policy whose model is in another process.

    Args:
        connection: from :meth:`PolicyServer.link`.
        name: which of the server's policies.
        facts: the server's, of that one.
    """

    embodiment: EmbodimentSpec
    cameras: tuple[str, ...]
    action_rate_hz: float
    horizon: int
    continues: bool
    n_obs_steps: int

    def __init__(self, connection: Connection, name: str, facts: PolicyFacts) -> None:
        vars(self).update(vars(facts))
        self._connection = connection
        self._name = name
        self._seed = self._calls = 0

    def reset(self, seed: int) -> None:
        self._seed, self._calls = seed, 0

    def predict_action(self, observation: Observation) -> Array:
        """``(horizon, dim)``.

        Raises:
            FluxError: what means bad input, as the policy raised it.
            RunFailed: the policy raised something else, or the server is gone.
        """
        return self._ask(Query(observation, self._seed, self._calls))

    def continue_action(self, observation: Observation, rest: Continuation) -> Array:
        """As ``predict_action``, for a chunk that continues ``rest``: see ``Actor``."""
        return self._ask(Query(observation, self._seed, self._calls, rest))

    def _ask(self, query: Query) -> Array:
        try:
            self._connection.send((self._name, query))
            kind, answer = self._connection.recv()
        except (EOFError, OSError) as error:
            raise RunFailed("the process with the policy is gone") from error
        if kind == "refused":
            raise answer
        if kind == "raised":
            raise RunFailed(f"the policy raised:\n{answer}")
        self._calls += 1
        chunk: Array = answer
        return chunk


def check_rows(policy: LocalPolicy) -> None:
    """Refuse a batch size with which a row's answer depends on its place or on the other rows.

    Raises:
        ConfigError: with what to set instead.
    """
    most = policy.batch_size
    if most == 1:
        return
    mine, others = (_probe(policy, share) for share in (0.25, 0.75))
    alone = policy.predict_batch([mine])[0]
    for place in {1, most // 2, most - 1}:
        rows = [others] * most
        rows[place] = mine
        if not np.array_equal(policy.predict_batch(rows)[place], alone):
            raise ConfigError(
                f"batch_size = {most}: on {policy.device} a row's result depends on the others "
                "in its batch, so episodes could not be repeated",
                cause="the device sums rows of one batch in different orders",
                next="--set <section>.batch_size=1, or another size",
            )


def _probe(policy: LocalPolicy, share: float) -> Query:
    spec = policy.embodiment
    joints = spec.state_joints or spec.joints
    rng = np.random.default_rng(int(1000 * share))
    observation: Observation = {
        "qpos": np.array([j.lower + share * (j.upper - j.lower) for j in joints], np.float32),
        "images": {
            camera.name: rng.integers(0, 256, (camera.height, camera.width, 3), np.uint8)
            for camera in spec.cameras
            if camera.name in policy.cameras
        },
        "task_description": "do the task",
    }
    return Query(with_history(observation, policy.n_obs_steps), int(1000 * share), 3)
