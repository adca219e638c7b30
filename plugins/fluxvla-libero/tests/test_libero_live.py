"""The live view: a stream of images for browsers on this machine."""

from __future__ import annotations

import threading
import urllib.request

import cv2
import numpy as np
import pytest
from fluxvla_libero.live_view import LiveView

from fluxvla_core.errors import RunFailed


def part(stream):
    """The next image of the stream."""
    assert stream.readline() == b"--frame\r\n"
    assert stream.readline() == b"Content-Type: image/jpeg\r\n"
    length = int(stream.readline().split(b":")[1])
    assert stream.readline() == b"\r\n"
    jpeg = stream.read(length)
    assert stream.readline() == b"\r\n"
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def test_viewers_see_the_newest_image_until_it_is_closed():
    red = np.zeros((16, 24, 3), np.uint8)
    red[..., 0] = 255
    with LiveView(0) as view:
        view.show(red)
        stream = urllib.request.urlopen(view.url, timeout=60)
        assert stream.headers["Content-Type"].startswith("multipart/x-mixed-replace")
        first = part(stream)
        assert first.shape == (16, 24, 3)
        assert np.abs(first.astype(int) - red).max() < 10, "in its colours"
        view.show(red // 2)
        assert part(stream)[0, 0, 0] < 140
    assert stream.read() == b"", "the stream ends with the view"
    view.close()


def test_it_can_be_seen_from_this_machine_alone():
    with LiveView(0) as view:
        assert view._server.server_address[0] == "127.0.0.1"
        assert view.url.startswith("http://127.0.0.1:")


def test_a_viewer_that_leaves_disturbs_nobody():
    before = threading.active_count()
    with LiveView(0) as view:
        urllib.request.urlopen(view.url, timeout=60).close()
        for shade in range(40):
            view.show(np.full((64, 64, 3), shade, np.uint8))
    assert threading.active_count() <= before + 1


def test_a_port_that_is_taken_is_named():
    with LiveView(0) as view:
        port = int(view.url.rstrip("/").rpartition(":")[2])
        with pytest.raises(RunFailed, match=f"cannot be served on port {port}") as caught:
            LiveView(port)
    assert "--set <section>.live_port=0" in str(caught.value)
