"""A live view: images as a stream that any browser shows, served on this machine only.

Motion JPEG, ``multipart/x-mixed-replace`` (RFC 2046 and Netscape's extension): each part replaces
the one before. Somebody who looks from elsewhere forwards the port, as with
``ssh -L 8000:localhost:8000 HOST``.
"""

from __future__ import annotations

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import RunFailed

HOST = "127.0.0.1"
_BOUNDARY = "frame"


class LiveView:
    """Serves the newest image until it is closed; use as a context manager.

    Args:
        port: 0 takes any that is free.

    Attributes:
        url: where to look.

    Raises:
        RunFailed: the port is not available.
    """

    def __init__(self, port: int) -> None:
        self._changed = threading.Condition()
        self._jpeg = b""
        self._number = 0
        self._closed = False
        view = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                kind = f"multipart/x-mixed-replace; boundary={_BOUNDARY}"
                self.send_header("Content-Type", kind)
                self.send_header("Cache-Control", "no-store")
                self.end_headers()
                try:
                    view._send(self)
                except OSError:  # the viewer has gone
                    return

            def log_message(self, format: str, *arguments: object) -> None:
                """Requests are nobody's business."""

        try:
            self._server = ThreadingHTTPServer((HOST, port), Handler)
        except OSError as error:
            raise RunFailed(
                f"the live view cannot be served on port {port}: {error}",
                next="--set <section>.live_port=0 for any that is free",
            ) from error
        self._server.daemon_threads = True
        self.url = f"http://{HOST}:{self._server.server_address[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def show(self, image: npt.NDArray[np.uint8]) -> None:
        """The newest ``(H, W, 3)`` uint8 RGB image; viewers that are slow miss some."""
        import cv2

        _, jpeg = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]))
        with self._changed:
            self._jpeg = jpeg.tobytes()
            self._number += 1
            self._changed.notify_all()

    def close(self) -> None:
        """Stop serving; any number of times."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *details: object) -> None:
        self.close()

    def _send(self, handler: BaseHTTPRequestHandler) -> None:
        sent = 0
        while True:
            with self._changed:
                while self._number == sent and not self._closed:
                    self._changed.wait()
                if self._closed:
                    return
                jpeg, sent = self._jpeg, self._number
            head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}"
            handler.wfile.write(head.encode() + b"\r\n\r\n" + jpeg + b"\r\n")
