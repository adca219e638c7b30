"""``LinkServer``: the main process's thread that serves the control process in an episode."""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from concurrent.futures import Future

from fluxvla_core.control import realtime
from fluxvla_core.control.interrupt import Interrupts
from fluxvla_core.control.policy_client import Answer, PolicyClient
from fluxvla_core.errors import FluxError
from fluxvla_core.robot.events import Phase
from fluxvla_core.robot.process.link import Link
from fluxvla_core.robot.process.messages import Kind, Message, error_fields
from fluxvla_core.robot.process.remote_policy_client import previous_chunk_of
from fluxvla_core.robot.robot import Robot

_POLL_S = 0.004
_WATCH_S = 0.02


class LinkServer:
    """Shows that this process runs, answers queries, and watches the cameras.

    In a thread of its own: whatever an observer, a hook or a person at the terminal does with the
    main thread, the control process is served.

    Args:
        link: the main process's end.
        robot: reads the cameras.
        interrupts: signals; passed on during an episode.

    Attributes:
        messages: what came that is for the main thread.
        answers: number of a query -> the policy's answer that was sent.
        raised: what was raised here and sent; it has a traceback.
        phase: of the episode, as far as the main thread knows.
    """

    def __init__(self, link: Link, robot: Robot, interrupts: Interrupts) -> None:
        self.messages: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self.answers: dict[int, Answer] = {}
        self.raised: deque[BaseException] = deque(maxlen=16)
        self.phase = Phase.OVER
        self._link, self._robot, self._interrupts = link, robot, interrupts
        self._client: PolicyClient | None = None
        self._signals = 0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="fluxvla-link", daemon=True)
        self._thread.start()

    @property
    def client(self) -> PolicyClient | None:
        """The policy client of the running episode; None between two."""
        return self._client

    @property
    def alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    def begin(self, client: PolicyClient) -> None:
        """An episode begins."""
        self.answers.clear()
        self.raised.clear()
        self._signals = len(self._interrupts.signals)
        self._client = client

    def end(self) -> None:
        """The episode is over."""
        self.phase, self._client = Phase.OVER, None

    def close(self) -> None:
        """End the thread, after what the control process sent last."""
        self._over.set()
        self._thread.join()

    def _serve(self) -> None:
        """Show that this process runs, answer queries, and watch the cameras."""
        realtime.raise_priority()
        watched = 0.0
        ended = False
        while not ended:
            ended = self._over.wait(_POLL_S)
            self._link.mark_alive()
            self._link.flush()
            self._pass_signals_on()
            while (message := self._link.receive()) is not None:
                if message.kind == Kind.QUERY:
                    self._ask(message)
                elif message.kind == Kind.LATE:
                    self._reply_delay(message["since"])
                else:
                    self.messages.put(message)
            now = time.monotonic()
            if self.phase.stoppable and now - watched > _WATCH_S:
                watched = now
                self._watch_cameras()

    def _pass_signals_on(self) -> None:
        """A hook may keep the main thread for long; the arm is stopped meanwhile."""
        signals = self._interrupts.signals
        if self._client is not None and len(signals) > self._signals:
            self._signals = len(signals)
            self._link.send(Kind.SIGNAL, number=signals[-1])

    def _ask(self, message: Message) -> None:
        client, number = self._client, message["number"]
        if client is None:
            return

        def answered(future: Future[Answer]) -> None:
            error = future.exception()
            if error is not None:
                self.raised.append(error)
                self._link.send(Kind.ANSWER, number=number, **error_fields(error))
                return
            answer = future.result()
            self.answers[number] = answer
            if answer.error is not None:
                refused = error_fields(answer.error)
                self._link.send(
                    Kind.ANSWER, number=number, observed=answer.observed, refused=refused
                )
            else:
                arrays = (answer.checked(),)
                self._link.send(Kind.ANSWER, arrays, number=number, observed=answer.observed)

        client.query(previous_chunk_of(message)).add_done_callback(answered)

    def _reply_delay(self, since: float) -> None:
        late, seconds = self._robot.delays.longest(since)
        self._link.send(
            Kind.REPLY,
            to=Kind.LATE,
            seconds=seconds,
            name=late.name,
            cause=late.cause,
            next=late.next,
        )

    def _watch_cameras(self) -> None:
        """A camera that falls silent stops the arm before the next query."""
        try:
            self._robot.state()
        except FluxError as error:
            self.raised.append(error)
            self._link.send(Kind.FAULT, **error_fields(error))
