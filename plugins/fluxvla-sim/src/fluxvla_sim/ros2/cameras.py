"""The cameras of a simulated robot: a thread that draws what somebody listens to."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from fluxvla_core.ros2 import IMAGE, Faults, Outbox, depth_stream, images, message_class
from fluxvla_sim.render import Renderer, import_mujoco
from fluxvla_sim.ros2.settings import NodeSettings


class Cameras(threading.Thread):
    """Draws each camera at its own time; ``check`` raises what ended the thread.

    Colours and distances of a camera come from one drawing and have one stamp, as an RGB-D camera's
    do. What nobody listens to is not drawn.

    Args:
        model: of the scene.
        publishers: stream -> publisher, of images (a camera's name) and of depth.
        cameras: names, of those that have a publisher.
        settings: rates, latencies and the size of the images.
        faults: shared with the other streams.
        look: takes ``mujoco.MjData`` to fill with the scene's positions, and gives their stamp.
        stopping: ends the thread.
    """

    def __init__(
        self,
        model: Any,
        publishers: Mapping[str, Any],
        cameras: tuple[str, ...],
        settings: NodeSettings,
        faults: Faults,
        look: Callable[[Any], Any],
        stopping: threading.Event,
    ) -> None:
        super().__init__(name="fluxvla-sim-cameras")
        self.sent = 0
        self._model, self._publishers, self._cameras = model, publishers, cameras
        self._settings, self._look, self._stopping = settings, look, stopping
        self._outbox = Outbox(faults)
        self._error: BaseException | None = None

    def run(self) -> None:
        try:
            self._draw_all()
        except BaseException as error:  # noqa: BLE001 - raised again by check
            self._error = error

    def check(self) -> None:
        """Nothing, while the thread draws."""
        if self._error is not None:
            raise self._error

    def _draw_all(self) -> None:
        renderer, data = Renderer(self._model), import_mujoco().MjData(self._model)
        period = 1.0 / (self._settings.camera_hz * self._settings.real_time_factor)
        start = time.monotonic()
        # Spread over the period, as cameras that nobody synchronised.
        due = {c: start + period * i / len(self._cameras) for i, c in enumerate(self._cameras)}
        try:
            while not self._stopping.is_set():
                self._outbox.flush(time.monotonic())
                camera = min(due, key=due.__getitem__)
                wait = min(due[camera], self._outbox.next_due) - time.monotonic()
                if wait > 0:
                    self._stopping.wait(wait)
                    continue
                self._draw(renderer, data, camera)
                due[camera] = max(due[camera] + period, time.monotonic())
        finally:
            renderer.close()

    def _draw(self, renderer: Renderer, data: Any, camera: str) -> None:
        depth = depth_stream(camera)
        there = [stream for stream in (camera, depth) if stream in self._publishers]
        wanted = [s for s in there if self._publishers[s].get_subscription_count()]
        if not wanted:
            return
        stamp = self._look(data)
        mujoco, model = import_mujoco(), self._model
        # All that an image needs of the physics, given the positions.
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        size = self._settings.height, self._settings.width
        if depth in wanted:
            pixels, metres = renderer.render_with_depth(data, camera, *size)
            self._send(depth, camera, images.to_millimetres(metres), "16UC1", stamp)
        else:
            pixels = renderer.render(data, camera, *size)
        if camera in wanted:
            self._send(camera, camera, pixels, "rgb8", stamp)

    def _send(self, stream: str, camera: str, pixels: Any, encoding: str, stamp: Any) -> None:
        message = images.fill(message_class(IMAGE)(), pixels, encoding)
        message.header.stamp, message.header.frame_id = stamp, camera
        now = time.monotonic() + self._settings.latency_s(stream)
        self._outbox.put(stream, self._publishers[stream], message, now)
        self.sent += 1
