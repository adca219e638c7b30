"""Connection to ROS 2: a node in a context, spun by one thread, shut down in the order that works.

A ``MultiThreadedExecutor`` loses messages and burns a core in the rclpy releases that are in use;
one thread that only stores messages keeps up with 240 VGA images a second. The context is our
own, so several connections, on several domains, live in one process, and nobody else's
``rclpy.shutdown`` ends this one. rclpy's signal handlers stay out: they invalidate the context
first, and then a last "hold" could not be published any more.
"""

from __future__ import annotations

import ctypes
import functools
import importlib
import importlib.util
import os
import re
import secrets
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

from fluxvla_core.control import realtime
from fluxvla_core.errors import ConfigError, Faulted, LoadFailed
from fluxvla_core.ros2 import qos
from fluxvla_core.ros2.streams import Stream

WATCH_S = 0.25
"""How often the graph is looked at: publishers that come, go or change what they offer."""
_JOIN_S = 5.0
# Without any timeout, rclpy 9.1's EventsExecutor keeps the GIL while it waits.
_SPIN_S = 3600.0
LARGE_FRAMES = Path(__file__).with_name("fastdds_large_frames.xml")
_LOOPBACK = Path(__file__).with_name("fastdds_loopback.xml")
_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_TRANSPORTS, _PROFILES = "FASTDDS_BUILTIN_TRANSPORTS", "FASTDDS_DEFAULT_PROFILES_FILE"
_MAX_DOMAIN = 232
# Python that each distribution's packages are built for (REP 2000).
_PYTHONS: Mapping[str, str] = {
    "humble": "3.10",
    "iron": "3.10",
    "jazzy": "3.12",
    "kilted": "3.12",
}
# mallopt(3), <malloc.h>.
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
# The largest that glibc takes (DEFAULT_MMAP_THRESHOLD_MAX on 64 bits).
_LARGEST = 32 << 20
_KEPT = 256 << 20


def require_rclpy(environ: Mapping[str, str] = os.environ) -> ModuleType:
    """Import ``rclpy``; returns the module.

    Raises:
        LoadFailed: it cannot be imported, or the middleware that the environment asks for cannot
            be loaded (``rclpy.init`` would end the process then); says how to get them.
    """
    try:
        _leave_out_generator()
        rclpy = importlib.import_module("rclpy")
    except ImportError as error:
        raise LoadFailed(
            f"ROS 2 cannot be used: importing rclpy fails ({error})",
            cause=_cause(error, environ),
            next="on a robot, source /opt/ros/<distribution>/setup.bash and use the Python that "
            "ROS was built for; for development (Linux, x86-64), "
            "pip install 'fluxvla-core[ros2]'",
        ) from error
    _require_middleware(environ)
    return rclpy


def _leave_out_generator() -> None:
    """Import what loads ROS's messages without what generates their code.

    ``rosidl_generator_py`` imports its generator where it is installed: parsers and their tables
    of 17 MB, which nothing needs that only uses messages.
    """
    generator = "rosidl_generator_py.generate_py_impl"
    if generator in sys.modules:
        return
    sys.modules[generator] = None  # type: ignore[assignment]  # importing it raises ImportError
    try:
        with suppress(ImportError):  # not there, or another one: rclpy says what it misses
            importlib.import_module("rosidl_generator_py")
    finally:
        del sys.modules[generator]


@contextmanager
def _udp_alone() -> Iterator[None]:
    """Let the participant that is created meanwhile have UDP alone of Fast DDS's transports.

    https://fast-dds.docs.eprosima.com, ``FASTDDS_BUILTIN_TRANSPORTS``. What a user says in this
    variable, or of transports in a profiles file, counts; ours for large frames is for images.
    """
    before = {name: os.environ.get(name) for name in (_TRANSPORTS, _PROFILES, _RANGE)}
    os.environ.setdefault(_TRANSPORTS, "UDPv4")
    if before[_RANGE] == "LOCALHOST":
        os.environ |= {_RANGE: "SUBNET", _PROFILES: str(_LOOPBACK)}
    elif before[_PROFILES] == str(LARGE_FRAMES):
        del os.environ[_PROFILES]
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


class Connection:
    """Opens a node at once; ``close`` gives everything back.

    Args:
        name: begins the node's name; process id and a random part make it unique.
        domain_id: the ROS domain; None takes ``ROS_DOMAIN_ID`` (0 without it).
        small: whether all messages are small: states and commands, as in the control process. They
            go through the loopback interface: Fast DDS's shared memory has locks, and a process
            that is stopped while it has one stops whoever sends to it. Callbacks come from rclpy's
            ``EventsExecutor`` where there is one (from Kilted on), at a third of the CPU time.

    Raises:
        LoadFailed: there is no rclpy here.
        ConfigError: the domain is no number from 0 to 232.
    """

    def __init__(self, name: str, domain_id: int | None = None, small: bool = False) -> None:
        rclpy = require_rclpy()
        _check_domain(domain_id)
        keep_large_blocks()
        from rclpy.context import Context
        from rclpy.signals import SignalHandlerOptions
        from rclpy.task import Future

        clean = re.sub(r"\W+", "_", name).strip("_") or "node"
        self.name = f"{clean}_{os.getpid()}_{secrets.token_hex(2)}"
        self.failure: BaseException | None = None
        self.streams: dict[str, Stream] = {}
        self._watchers: list[Callable[[], None]] = []
        self._closing = threading.Event()
        self._closed: Any = Future()
        self._lock = threading.Lock()
        self._context = Context()
        transports = ExitStack()
        if small:
            transports.enter_context(_udp_alone())
        with transports:
            rclpy.init(
                args=[],
                context=self._context,
                domain_id=domain_id,
                signal_handler_options=SignalHandlerOptions.NO,
            )
            try:
                self.node = rclpy.create_node(
                    self.name,
                    context=self._context,
                    enable_rosout=False,
                    start_parameter_services=False,
                )
            except BaseException:
                self._context.try_shutdown()
                raise
        try:
            self.domain: int = self._context.get_domain_id()
            self.every(WATCH_S, self._watch)
            self._loops_in_cpp, self._executor = _executor(self._context, small)
            self._executor.add_node(self.node)
        except BaseException:
            self._context.try_shutdown()
            raise
        # Not a daemon: a daemon thread inside rcl at interpreter exit ends in std::terminate.
        self._thread = threading.Thread(target=self._spin, name=self.name)
        self._thread.start()

    def subscribe(
        self, name: str, topic: str, message: Any, depth: int, latched: bool = False
    ) -> Stream:
        """A stream that keeps the last ``depth`` messages of class ``message``."""
        stream = Stream(self.node, name, topic, message, depth, latched)
        self.streams[name] = stream
        return stream

    def publisher(
        self,
        topic: str,
        message: Any,
        reliability: str = qos.RELIABLE,
        depth: int = 1,
        latched: bool = False,
    ) -> Any:
        """A publisher, by default for commands: RELIABLE matches every subscription, and with a
        depth of 1 a command that was overtaken by a newer one is never sent again. ``latched``
        (transient local) also sends the last messages to subscribers that come later."""
        return self.node.create_publisher(message, topic, qos.profile(reliability, depth, latched))

    def every(self, seconds: float, callback: Callable[[], None]) -> Any:
        """Call back from the ROS thread, on the steady clock (wall clocks get stepped)."""
        from rclpy.clock import Clock, ClockType

        clock = Clock(clock_type=ClockType.STEADY_TIME)
        return self.node.create_timer(seconds, callback, clock=clock)

    def watch(self, callback: Callable[[], None]) -> None:
        """Also call ``callback`` whenever the graph is looked at (ROS thread, ``WATCH_S``)."""
        self._watchers.append(callback)

    def check(self) -> None:
        """Return while the connection is open and its thread runs.

        Raises:
            Faulted: it was closed, or a callback ended its thread; carries that error.
        """
        if self.failure is not None:
            raise Faulted(f"the ROS thread of {self.name} ended: {self.failure}") from self.failure
        if self._closing.is_set():
            raise Faulted(f"the connection {self.name} is closed")

    def close(self) -> None:
        """Stop the thread, then destroy node and context; any number of times, from any thread."""
        with self._lock:
            if self._closing.is_set():
                return
            self._closing.set()
        self._closed.set_result(None)
        self._executor.wake()
        if threading.current_thread() is not self._thread:
            self._thread.join(_JOIN_S)

    def _watch(self) -> None:
        # A main thread that ends without close() is noticed, and the process does not hang on a
        # thread that it must join.
        if not threading.main_thread().is_alive() or not self._context.ok():
            self._closing.set()
            self._closed.set_result(None)
            return
        for stream in self.streams.copy().values():
            stream.refresh()
        for callback in self._watchers:
            callback()

    def _spin(self) -> None:
        # The thread that sends commands waits for the interpreter lock while this one has it.
        realtime.raise_priority()
        try:
            while not self._closing.is_set():
                if self._loops_in_cpp:
                    self._executor.spin_until_future_complete(self._closed, _SPIN_S)
                else:
                    self._executor.spin_once(timeout_sec=WATCH_S)
        except BaseException as error:  # noqa: BLE001 - kept, and raised by the next ``check``
            self.failure = error
        finally:
            self._closing.set()
            self._executor.shutdown()
            self.node.destroy_node()
            self._context.try_shutdown()


def _executor(context: Any, events: bool) -> tuple[bool, Any]:
    """An executor, and whether it loops over messages in C++."""
    # Jazzy has no such module.
    if events and importlib.util.find_spec("rclpy.experimental") is not None:
        from rclpy.experimental import EventsExecutor

        return True, EventsExecutor(context=context)
    from rclpy.executors import SingleThreadedExecutor

    return False, SingleThreadedExecutor(context=context)


def _check_domain(domain_id: int | None) -> None:
    given: object = domain_id if domain_id is not None else os.environ.get("ROS_DOMAIN_ID") or 0
    try:
        number = int(str(given))
    except ValueError:
        number = -1
    if not 0 <= number <= _MAX_DOMAIN:
        raise ConfigError(f"a ROS domain is a number from 0 to {_MAX_DOMAIN}, got {given!r}")


@functools.cache
def keep_large_blocks() -> bool:
    """Reuse the memory of large messages (``mallopt``); returns whether the C library can.

    An image is larger than what malloc keeps: each message, and each copy of one, would be asked
    of the kernel and given back to it, page by page, which takes longer than copying the image
    and stops the process's other threads meanwhile. glibc keeps larger blocks if configured to
    (mallopt(3)); other C libraries are left as they are. Memory stays bounded by what was in use at
    one time.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, _LARGEST) and mallopt(_M_TRIM_THRESHOLD, _KEPT))


def _cause(error: ImportError, environ: Mapping[str, str]) -> str:
    if "cannot open shared object" in str(error):
        return "a library of ROS 2 is missing (with wheels: ros-kilted-rmw-fastrtps-cpp)"
    distribution = environ.get("ROS_DISTRO", "")
    built_for = _PYTHONS.get(distribution)
    here = f"{sys.version_info[0]}.{sys.version_info[1]}"
    if built_for and built_for != here:
        return f"ROS 2 {distribution} is built for Python {built_for}, this is Python {here}"
    if distribution:
        return f"ROS 2 {distribution} is sourced, but this Python does not see its packages"
    return "no ROS 2 is installed for this Python, or its setup file was not sourced"


def _require_middleware(environ: Mapping[str, str]) -> None:
    name = environ.get("RMW_IMPLEMENTATION")
    if not name:
        return
    try:
        ctypes.CDLL(f"lib{name}.so")
    except OSError as error:
        raise LoadFailed(
            f"RMW_IMPLEMENTATION is {name!r}, and that middleware cannot be loaded ({error})",
            next="unset RMW_IMPLEMENTATION, or install the middleware that it names",
        ) from error
