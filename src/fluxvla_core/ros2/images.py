"""``sensor_msgs/Image`` and ``CompressedImage`` to numpy and back; an image is copied once.

A message's ``data`` is an ``array.array``; numpy can look at it without copying (0.6 us for a VGA
image, against 18 ms through a list). Going back, only an ``array.array`` is taken as it is; bytes
and ndarrays are converted byte by byte, or refused when field checks are on.
Encodings are those of sensor_msgs' ``image_encodings.hpp``; depth follows REP 118.
"""

from __future__ import annotations

import array
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import LoadFailed
from fluxvla_core.ros2.messages import BadMessage

# encoding -> (element type, number of channels, columns that are red, green and blue)
_COLOUR: Mapping[str, tuple[int, tuple[int, int, int]]] = {
    "rgb8": (3, (0, 1, 2)),
    "8UC3": (3, (2, 1, 0)),
    "bgr8": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "mono8": (1, (0, 0, 0)),
    "8UC1": (1, (0, 0, 0)),
}
GREY = ("mono8", "8UC1")
"""Encodings of images without colours: taken only where the camera is said to have none."""
_DEPTH: Mapping[str, type[np.generic]] = {
    "16UC1": np.uint16,
    "mono16": np.uint16,
    "32FC1": np.float32,
}
_MILLIMETRE = np.float32(1e-3)
# What OpenCV makes, by the name that a CompressedImage's format has for it.
_PACKED = ("jpeg", "png")
# image_transport's compressedDepth puts its parameters (one enum, two floats) before the PNG.
_DEPTH_HEADER = 12


def view(message: Any, source: str = "image") -> npt.NDArray[Any]:
    """The pixels of an ``Image`` where they lie: ``(height, width, channels)``, channels as sent.

    Rows may be padded (``step``). Numbers of the other byte order are swapped, which copies.

    Raises:
        BadMessage: an unknown encoding, or fewer bytes than the header promises; names ``source``.
    """
    encoding = message.encoding
    if encoding in _COLOUR:
        channels = _COLOUR[encoding][0]
    elif encoding in _DEPTH:
        channels = 1
    else:
        known = ", ".join([*_COLOUR, *_DEPTH])
        raise BadMessage(
            f"{source} sends images with encoding {encoding!r}; understood are {known}",
            next="set the camera driver to one of them (rgb8 costs the least)",
        )
    dtype: np.dtype[Any] = np.dtype(_DEPTH.get(encoding, np.uint8))
    row = message.width * channels * dtype.itemsize
    size = message.step * (message.height - 1) + row if message.height else 0
    if message.step < row or len(message.data) < size:
        raise BadMessage(
            f"{source} sends damaged images: {message.width}x{message.height} {encoding} with "
            f"rows of {message.step} bytes needs {max(size, row)} bytes, got {len(message.data)}"
        )
    pixels: npt.NDArray[Any] = np.ndarray(
        (message.height, message.width, channels),
        dtype,
        buffer=memoryview(message.data),
        strides=(message.step, channels * dtype.itemsize, dtype.itemsize),
    )
    if message.is_bigendian and dtype.itemsize > 1:
        pixels = pixels.byteswap()
    return pixels


def to_rgb(
    message: Any, height: int, width: int, source: str = "image", grey: bool = False
) -> npt.NDArray[np.uint8]:
    """A fresh ``(height, width, 3)`` uint8 RGB array from an ``Image`` or ``CompressedImage``.

    Args:
        grey: whether the camera has no colours: its images are alike in all three channels.

    Raises:
        BadMessage: another size, no colour image, or damaged; names ``source``.
        LoadFailed: a compressed image, and no decoder is installed.
    """
    if is_compressed(message):
        image = _decode(message, source, colour=True)
        if image.ndim == 2:
            image = image[..., None].repeat(3, 2)
            _check_colours(GREY[0], grey, source)
        _check_colours(message.format.partition(";")[0].strip(), grey, source)
        _check_size(image, height, width, source)
        return image
    pixels = view(message, source)
    if message.encoding not in _COLOUR:
        raise BadMessage(
            f"{source} sends {message.encoding} images, which have no colours",
            cause="a depth topic is given where a colour topic belongs",
        )
    _check_colours(message.encoding, grey, source)
    _check_size(pixels, height, width, source)
    order = _COLOUR[message.encoding][1]
    rgb = np.empty((height, width, 3), np.uint8)
    if order == (0, 1, 2):
        np.copyto(rgb, pixels[..., :3])
    else:
        # Plane by plane takes a fifth of a reversed copy, whose inner loop is 3 long.
        for plane, column in enumerate(order):
            np.copyto(rgb[..., plane], pixels[..., column])
    return rgb


def to_depth(
    message: Any, height: int, width: int, source: str = "image"
) -> npt.NDArray[np.float32]:
    """A fresh ``(height, width)`` float32 array in metres, NaN where nothing was measured.

    ``16UC1`` holds millimetres with 0 for nothing, ``32FC1`` metres with NaN (REP 118).

    Raises:
        BadMessage: another size, no depth image, or damaged; names ``source``.
        LoadFailed: a compressed image, and no decoder is installed.
    """
    if is_compressed(message):
        pixels = _decode(message, source, colour=False)
    elif message.encoding in _DEPTH:
        pixels = view(message, source)[..., 0]
    else:
        view(message, source)
        raise BadMessage(
            f"{source} sends {message.encoding} images, which hold no distances",
            cause="a colour topic is given where a depth topic belongs",
        )
    _check_size(pixels, height, width, source)
    metres = np.array(pixels, np.float32)
    if pixels.dtype == np.uint16:
        metres *= _MILLIMETRE
        metres[metres == 0] = np.nan
    return metres


def to_millimetres(metres: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16]:
    """``(height, width)`` metres as ``16UC1`` (mm): 0 for NaN and beyond 65.535 m."""
    far = np.rint(np.nan_to_num(metres, posinf=0.0, neginf=0.0) / _MILLIMETRE)
    return np.where((far > 0) & (far <= np.iinfo(np.uint16).max), far, 0).astype(np.uint16)


def fill(message: Any, pixels: npt.NDArray[Any], encoding: str) -> Any:
    """Put ``(height, width[, channels])`` pixels into an ``Image``; returns the message.

    The pixels are copied once; ``header`` is left alone.

    Raises:
        ValueError: the array does not fit the encoding.
    """
    channels = _check_array(pixels, encoding)
    data = array.array("B")
    data.frombytes(np.ascontiguousarray(pixels).data.cast("B"))
    message.height, message.width = pixels.shape[:2]
    message.encoding = encoding
    message.step = pixels.shape[1] * channels * pixels.dtype.itemsize
    message.is_bigendian = 0 if np.little_endian else 1
    message.data = data
    return message


def fill_compressed(
    message: Any, pixels: npt.NDArray[Any], encoding: str, form: str = "jpeg"
) -> Any:
    """Put pixels, as :func:`fill` takes them, into a ``CompressedImage``; returns the message.

    ``header`` is left alone.

    Args:
        form: ``jpeg``, which loses a little, or ``png``, which does not; millimetres (``16UC1``)
            are only ever ``png``.

    Raises:
        ValueError: the array does not fit the encoding, or the form cannot hold it.
        LoadFailed: OpenCV is not installed.
    """
    channels = _check_array(pixels, encoding)
    if form not in _PACKED:
        raise ValueError(f"unknown form {form!r}; there are {', '.join(_PACKED)}")
    if encoding in _COLOUR:
        shaped = pixels.reshape(*pixels.shape[:2], channels)
        # OpenCV has blue first.
        pixels = shaped[..., _COLOUR[encoding][1][::-1]]
        message.format = f"{encoding}; {form} compressed bgr8"
    elif pixels.dtype == np.uint16 and form == "png":
        message.format = "16UC1; png compressed"
    else:
        raise ValueError(f"{form} cannot hold {encoding}; png can hold 16UC1")
    cv2 = _opencv("compressed images are to be sent", "send them uncompressed")
    done, packed = cv2.imencode(f".{form}", np.ascontiguousarray(pixels))
    if not done:
        raise ValueError(f"OpenCV makes no {form} of {encoding} {pixels.shape}")
    message.data = array.array("B", packed.tobytes())
    return message


def is_compressed(message: Any) -> bool:
    """Whether the message is a ``CompressedImage`` (those say ``format``, not ``encoding``)."""
    return hasattr(message, "format") and not hasattr(message, "encoding")


def _check_array(pixels: npt.NDArray[Any], encoding: str) -> int:
    """How many channels an encoding has; raises ValueError if the array does not fit it."""
    if encoding not in _COLOUR and encoding not in _DEPTH:
        raise ValueError(f"unknown encoding {encoding!r}")
    channels = _COLOUR[encoding][0] if encoding in _COLOUR else 1
    dtype: np.dtype[Any] = np.dtype(_DEPTH.get(encoding, np.uint8))
    wanted = pixels.shape[:2] if channels == 1 else (*pixels.shape[:2], channels)
    if pixels.dtype != dtype or pixels.shape not in (wanted, (*pixels.shape[:2], channels)):
        raise ValueError(
            f"{encoding} needs {dtype} of shape {wanted}, got {pixels.dtype} {pixels.shape}"
        )
    return channels


def _check_size(pixels: npt.NDArray[Any], height: int, width: int, source: str) -> None:
    if pixels.shape[:2] != (height, width):
        raise BadMessage(
            f"{source} sends {pixels.shape[1]}x{pixels.shape[0]} images, "
            f"the embodiment says {width}x{height}",
            next="set the camera driver's resolution, or the operator's height and width",
        )


def _check_colours(encoding: str, grey: bool, source: str) -> None:
    if encoding in GREY and not grey:
        raise BadMessage(
            f"{source} sends {encoding} images, which have no colours",
            cause="the camera's mode was changed, or the topic is an infrared or a grey camera's",
            next="set the driver to rgb8 or name the colour topic; a camera that has no colours is "
            "declared with encoding='mono8'",
        )


def _decode(message: Any, source: str, colour: bool) -> npt.NDArray[Any]:
    cv2 = _opencv(f"{source} sends compressed images", "name the uncompressed topic")
    data = np.frombuffer(message.data, np.uint8)
    if colour:
        image = cv2.imdecode(data, cv2.IMREAD_ANYCOLOR) if data.size else None
        if image is not None and image.ndim == 2:
            return np.asarray(image)
        if image is not None:
            return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
    elif message.format.startswith("16UC1"):
        data = data[_DEPTH_HEADER:] if "compressedDepth" in message.format else data
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
        if image is not None and image.dtype == np.uint16 and image.ndim == 2:
            return np.asarray(image)
    else:
        raise BadMessage(
            f"{source} sends compressed depth as {message.format!r}; only 16UC1 is understood",
            next="name the uncompressed depth topic",
        )
    raise BadMessage(
        f"{source} sends a compressed image ({message.format!r}, {data.size} bytes) "
        "that cannot be decoded"
    )


def _opencv(why: str, instead: str) -> Any:
    try:
        import cv2
    except ImportError as error:
        raise LoadFailed(
            f"{why}, and OpenCV is not installed ({error})",
            next=f"pip install opencv-python-headless, or {instead}",
        ) from error
    return cv2
