"""``FrameChannel``: an operator's frames on their way from the control process to the main process.

There is one frame at a time, and only where the main process requested one: what is requested is
written while nobody reads, and read while nobody writes. A request, and its answer, is a number in
shared memory and then a signal of an ``eventfd``; that system call also orders the memory's
contents, whatever the order is in which a processor sees the stores. Nothing is pickled: a frame is
JSON values and arrays of numbers.
"""

from __future__ import annotations

import json
import mmap
import os
import select
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import STATE, Frame, RobotFrame
from fluxvla_core.control.safety import BadFrame
from fluxvla_core.robot.process.link import allocate
from fluxvla_core.robot.robot import is_number
from fluxvla_core.spec import EmbodimentSpec

AnyArray = npt.NDArray[Any]
_ASKED, _ANSWERED, _LENGTH = 0, 1, 2
_NUMBERS = 64
_ALIGNED = 64
# Room for the JSON values: names, stamps, or an error's message.
_TEXT = 64 * 1024
_IMAGE, _DEPTH, _BASE = "image ", "depth ", "base"
_MORE, _MEASURED = "more ", "measured"


class FrameMemory(NamedTuple):
    """File descriptors: of the shared memory, and of the events 'requested' and 'answered'."""

    memory: int
    requested: int
    answered: int

    def close(self) -> None:
        """Close them; what maps the memory keeps it."""
        for descriptor in self:
            os.close(descriptor)


def frame_bytes(embodiment: EmbodimentSpec, cameras: Iterable[str]) -> int:
    """Bytes that a frame takes at most: state, base, and the image and depth of each camera."""
    pixels = {camera.name: camera.height * camera.width for camera in embodiment.cameras}
    images = sum(_aligned(3 * pixels[name]) + _aligned(4 * pixels[name]) for name in cameras)
    return _NUMBERS + _TEXT + 2 * _aligned(8 * embodiment.state_dim) + _ALIGNED + images


def make_frame_memory(size: int) -> FrameMemory:
    """Memory for frames of ``size`` bytes; it is gone with the processes that have it.

    Raises:
        OSError: there is not so much memory.
    """
    memory = allocate("fluxvla-frames", size)
    return FrameMemory(memory, os.eventfd(0, os.EFD_CLOEXEC), os.eventfd(0, os.EFD_CLOEXEC))


@dataclass(frozen=True)
class FrameMessage:
    """A frame or observation as it is sent to the main process through shared memory.

    Args:
        fields: JSON values.
        arrays: arrays of numbers, by name.
    """

    fields: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, AnyArray] = field(default_factory=dict)


class FrameChannel:
    """One end; one thread of each process uses it.

    Args:
        descriptors: of ``make_frame_memory``; they belong to the channel from now on.
    """

    def __init__(self, descriptors: FrameMemory) -> None:
        self._descriptors = descriptors
        size = os.fstat(descriptors.memory).st_size
        memory = memoryview(mmap.mmap(descriptors.memory, size))
        # Of the machine's own word size: each is read and written in one piece.
        self._numbers = memory[:_NUMBERS].cast("Q")
        self._data = np.frombuffer(memory, np.uint8)[_NUMBERS:]
        self._poll = select.poll()
        self._poll.register(descriptors.answered, select.POLLIN)

    def close(self) -> None:
        """Close the descriptors; no other thread uses the channel any more."""
        self._descriptors.close()

    # The main process's end.

    def request(self) -> None:
        """Request a frame; the one before was taken, or nobody waits for it any more."""
        self._numbers[_ASKED] += 1
        os.eventfd_write(self._descriptors.requested, 1)

    def answered(self, seconds: float) -> bool:
        """Wait for the answer; whether it came within so many seconds."""
        if self._poll.poll(seconds * 1e3):
            os.eventfd_read(self._descriptors.answered)
        return self._numbers[_ANSWERED] == self._numbers[_ASKED]

    def take(self) -> FrameMessage:
        """The answer, in fresh arrays."""
        length = self._numbers[_LENGTH]
        fields, layout = json.loads(self._data[:length].tobytes())
        arrays, at = {}, _aligned(length)
        for name, kind, shape in layout:
            dtype = np.dtype(kind)
            size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
            arrays[name] = self._data[at : at + size].view(dtype).reshape(shape).copy()
            at += _aligned(size)
        return FrameMessage(fields, arrays)

    # The control process's end.

    def wait_for_request(self) -> None:
        """Wait until a frame is requested."""
        os.eventfd_read(self._descriptors.requested)

    def fits(self, message: FrameMessage) -> bool:
        """Whether there is room for it."""
        return len(self._data) >= sum(
            [_aligned(len(_text(message))), *(_aligned(a.nbytes) for a in message.arrays.values())]
        )

    def answer(self, message: FrameMessage) -> None:
        """Answer the request; ``message`` fits."""
        text = _text(message)
        self._numbers[_LENGTH] = len(text)
        self._data[: len(text)] = np.frombuffer(text, np.uint8)
        at = _aligned(len(text))
        for array in message.arrays.values():
            room = self._data[at : at + array.nbytes]
            # numpy releases the GIL while it copies an image.
            np.copyto(room.view(array.dtype).reshape(array.shape), array)
            at += _aligned(array.nbytes)
        self._numbers[_ANSWERED] = self._numbers[_ASKED]
        os.eventfd_write(self._descriptors.answered, 1)


def message_of_frame(frame: Frame, cameras: Iterable[str], source: str) -> FrameMessage:
    """State, stamps, base, and the images and depth of ``cameras`` of a frame.

    Args:
        frame: of the operator; an image that is None has not come yet.
        cameras: the requested ones.
        source: what gave it, for messages.

    Raises:
        BadFrame: the state or an image is no array of numbers.
    """
    stamps = {str(k): float(v) if is_number(v) else None for k, v in frame.stamps.items()}
    images = {n: frame.images[n] for n in cameras if frame.images.get(n) is not None}
    arrays = {STATE: _numbers(frame.state, f"the state of {source}")} | {
        _IMAGE + name: _numbers(image, f"camera {name} of {source}")
        for name, image in images.items()
    }
    if isinstance(frame, RobotFrame):
        depths = {n: frame.depths[n] for n in cameras if frame.depths.get(n) is not None}
        arrays |= {
            _DEPTH + name: _numbers(depth, f"depth {name} of {source}").astype(
                np.float32, copy=False
            )
            for name, depth in depths.items()
        }
        if frame.base is not None:
            arrays[_BASE] = _numbers(frame.base, f"the base of {source}")
    return FrameMessage({"stamps": stamps}, arrays)


def frame_of(message: FrameMessage) -> Frame:
    """The frame of ``message_of_frame``."""
    images, depths = _named(message, _IMAGE), _named(message, _DEPTH)
    state, stamps = message.arrays[STATE], message.fields["stamps"]
    return RobotFrame(state, images, stamps, depths, message.arrays.get(_BASE))


def message_of_observation(
    window: Mapping[str, Any], frame: Frame | None, cameras: Iterable[str], source: str
) -> FrameMessage:
    """What a runner's ``update_observation_window`` returned.

    Args:
        window: ``qpos`` and ``images``; None for what has not come yet. What else it has is arrays
            of numbers or JSON values.
        frame: that it was made of, where the operator has frames: state and stamps are sent.
        cameras: the requested ones.
        source: what gave it, for messages.

    Raises:
        BadFrame: it has something that is neither an array of numbers nor a JSON value.
    """
    images = window.get("images")
    if not isinstance(images, Mapping):
        return FrameMessage({"window": None if images is None else repr(images)[:200]})
    shown = Frame(window.get("qpos"), images, {} if frame is None else frame.stamps)  # type: ignore[arg-type]
    more = {key: value for key, value in window.items() if key not in ("qpos", "images")}
    arrays = {_MORE + k: _numbers(v, f"{k} of {source}") for k, v in more.items() if _is_array(v)}
    values = {key: value for key, value in more.items() if _MORE + key not in arrays}
    try:
        json.dumps(values)
    except (TypeError, ValueError) as error:
        raise BadFrame(
            f"{source} has something that no other process can be given: {error}",
            next="--set <section>.control_process=false keeps it in one process",
        ) from error
    waits = [name for name in cameras if name in images and images[name] is None]
    if window.get("qpos") is None:
        shown = replace(shown, state=np.empty(0))
        waits.append(STATE)
    if isinstance(frame, RobotFrame):
        shown = RobotFrame(shown.state, shown.images, shown.stamps, frame.depths, frame.base)
    message = message_of_frame(shown, cameras, source)
    if frame is not None:
        arrays[_MEASURED] = _numbers(frame.state, f"the state of {source}")
    fields = {"window": values, "waits": waits, "frame": frame is not None}
    return FrameMessage({**message.fields, **fields}, {**message.arrays, **arrays})


def observation_of(message: FrameMessage) -> tuple[dict[str, Any], Frame | None]:
    """The observation of ``message_of_observation``, and the frame with its images."""
    values = message.fields["window"]
    if not isinstance(values, dict):
        return {"images": values}, None
    shown = frame_of(message)
    more = _named(message, _MORE)
    waits = message.fields["waits"]
    images = {**shown.images, **{name: None for name in waits if name != STATE}}
    window = {"qpos": None if STATE in waits else shown.state, "images": images, **values, **more}
    frame = replace(shown, state=message.arrays[_MEASURED]) if message.fields["frame"] else None
    return window, frame


def _named(message: FrameMessage, kind: str) -> dict[str, AnyArray]:
    return {k.removeprefix(kind): a for k, a in message.arrays.items() if k.startswith(kind)}


def _is_array(value: Any) -> bool:
    return isinstance(value, (np.ndarray, np.generic))


def _numbers(value: Any, source: str) -> AnyArray:
    found = np.asarray(value) if isinstance(value, (np.ndarray, np.generic, list, tuple)) else None
    if found is None or found.dtype.kind not in "biuf":
        raise BadFrame(f"{source} is no array of numbers, but a {type(value).__name__}")
    return found


def _text(message: FrameMessage) -> bytes:
    layout = [(name, array.dtype.str, array.shape) for name, array in message.arrays.items()]
    return json.dumps([message.fields, layout], separators=(",", ":")).encode()


def _aligned(size: int) -> int:
    return -(-size // _ALIGNED) * _ALIGNED
