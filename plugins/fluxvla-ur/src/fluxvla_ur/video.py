"""Cameras that the operating system or a network stream has, through OpenCV; no ROS needed."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import LoadFailed, NotReady
from fluxvla_core.operators import Camera
from fluxvla_core.ros2 import BadMessage

Image = npt.NDArray[np.uint8]


class VideoCamera:
    """A thread that keeps a camera's newest image.

    Args:
        camera: its name and the size that its images have.
        source: a device's number, or a path or URL that OpenCV opens.
    """

    def __init__(self, camera: Camera, source: int | str) -> None:
        self.camera = camera
        self._source = source
        self._capture: Any = None
        self._newest: tuple[float, Image] | None = None
        self._closing = threading.Event()
        name = f"fluxvla-{camera.name}"
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def connect(self) -> None:
        """Open the device.

        Raises:
            LoadFailed: OpenCV is not installed.
            NotReady: it cannot be opened.
        """
        try:
            import cv2
        except ImportError as error:
            raise LoadFailed(
                f"camera {self.camera.name} needs OpenCV, which cannot be imported: {error}",
                next="pip install opencv-python-headless",
            ) from error
        self._capture = cv2.VideoCapture(self._source)
        if isinstance(self._source, int):
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, self.camera.width)
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self.camera.height)
        if not self._capture.isOpened():
            raise NotReady(
                f"camera {self.camera.name} ({self._source}) cannot be opened",
                cause="it is not plugged in, has another number, or another program has it",
                next="v4l2-ctl --list-devices shows what there is",
            )
        self._thread.start()

    def newest(self) -> tuple[float, Image] | None:
        """Receipt (monotonic, s) and the newest ``(H, W, 3)`` RGB image; None before the first.

        Raises:
            BadMessage: the images have another size.
        """
        newest = self._newest
        size = self.camera.height, self.camera.width, 3
        if newest is not None and newest[1].shape != size:
            raise BadMessage(
                f"camera {self.camera.name} gives {newest[1].shape} images, "
                f"the embodiment says {size}"
            )
        return newest

    def close(self) -> None:
        """End the thread, give the device back; any number of times."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        if self._capture is not None:
            self._capture.release()

    def _run(self) -> None:
        while not self._closing.is_set():
            there, image = self._capture.read()
            if not there:
                # Every read of a device that is gone fails at once; its newest image grows old.
                self._closing.wait(0.05)
                continue
            self._newest = time.monotonic(), np.ascontiguousarray(image[..., ::-1])
