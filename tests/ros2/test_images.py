"""Images: encodings, row steps, byte order, sizes, compressed ones, and the way back."""

from __future__ import annotations

import array
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest

from fluxvla_core.errors import LoadFailed
from fluxvla_core.ros2 import BadMessage, images


def message(pixels, encoding, pad=0, bigendian=0):
    """An Image as rclpy delivers it; ``pad`` bytes of rubbish end each row."""
    pixels = np.ascontiguousarray(pixels)
    rows = pixels.reshape(pixels.shape[0], -1).view(np.uint8)
    rubbish = np.full((len(rows), pad), 0xAA, np.uint8)
    data = array.array("B", np.hstack([rows, rubbish]).tobytes())
    return SimpleNamespace(
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=bigendian,
        step=rows.shape[1] + pad,
        data=data,
    )


def colours(height=4, width=6):
    return np.arange(height * width * 3, dtype=np.uint8).reshape(height, width, 3)


@pytest.mark.parametrize("pad", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "sent"),
    [
        ("rgb8", lambda rgb: rgb),
        ("bgr8", lambda rgb: rgb[..., ::-1]),
        ("8UC3", lambda rgb: rgb[..., ::-1]),
        ("rgba8", lambda rgb: np.dstack([rgb, np.full(rgb.shape[:2], 9, np.uint8)])),
        ("bgra8", lambda rgb: np.dstack([rgb[..., ::-1], np.full(rgb.shape[:2], 9, np.uint8)])),
    ],
)
def test_colours_come_out_as_rgb(encoding, sent, pad):
    rgb = colours()

    got = images.to_rgb(message(sent(rgb), encoding, pad), 4, 6)

    np.testing.assert_array_equal(got, rgb)
    assert got.flags.c_contiguous


def test_grey_is_grey_in_all_three_channels():
    grey = np.arange(24, dtype=np.uint8).reshape(4, 6)

    np.testing.assert_array_equal(
        images.to_rgb(message(grey, "mono8", 2), 4, 6, grey=True), grey[..., None].repeat(3, 2)
    )


@pytest.mark.parametrize("order", ["little", "big"])
def test_millimetres_become_metres_and_nothing_becomes_nan(order):
    sent = np.array([[0, 1500], [65535, 1]], np.uint16)
    wire = sent.astype(">u2" if order == "big" else "<u2")

    got = images.to_depth(message(wire, "16UC1", 4, bigendian=order == "big"), 2, 2)

    assert got.dtype == np.float32
    np.testing.assert_allclose(got, [[np.nan, 1.5], [65.535, 0.001]], rtol=1e-6)


def test_every_millimetre_is_there_and_back():
    sent = np.arange(65536, dtype=np.uint16).reshape(256, 256)

    metres = images.to_depth(message(sent, "16UC1"), 256, 256)

    np.testing.assert_array_equal(images.to_millimetres(metres), sent)


def test_metres_stay_metres():
    sent = np.array([[0.5, np.nan]], np.float32)

    np.testing.assert_array_equal(images.to_depth(message(sent, "32FC1", 8), 1, 2), sent)


def test_a_view_copies_nothing_and_an_image_is_copied_once():
    sent = message(np.zeros((480, 640, 3), np.uint8), "rgb8")
    assert np.shares_memory(images.view(sent), np.frombuffer(sent.data, np.uint8))

    tracemalloc.start()
    got = images.to_rgb(sent, 480, 640)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert got.nbytes <= peak < 1.1 * got.nbytes
    assert not np.shares_memory(got, np.frombuffer(sent.data, np.uint8))


@pytest.mark.parametrize(
    ("call", "sent", "what"),
    [
        ("to_rgb", message(colours(8, 6), "rgb8"), "sends 6x8 images, the embodiment says 6x4"),
        ("to_rgb", message(colours(), "yuv422"), "encoding 'yuv422'; understood are rgb8"),
        ("to_rgb", message(np.zeros((4, 6), np.uint16), "16UC1"), "16UC1 images, which have no"),
        ("to_rgb", message(np.zeros((4, 6), np.uint8), "mono8"), "mono8 images, which have no c"),
        ("to_rgb", message(np.zeros((4, 6), np.uint8), "8UC1"), "8UC1 images, which have no col"),
        ("to_depth", message(colours(), "rgb8"), "rgb8 images, which hold no distances"),
        ("to_depth", message(np.zeros((8, 6), np.uint16), "16UC1"), "sends 6x8 images"),
    ],
)
def test_what_does_not_fit_is_named(call, sent, what):
    with pytest.raises(BadMessage, match=what) as caught:
        getattr(images, call)(sent, 4, 6, "cam_high (/camera)")

    assert caught.value.what.startswith("cam_high (/camera) sends")


@pytest.mark.parametrize("change", [{"step": 10}, {"height": 5}, {"data": array.array("B")}])
def test_damaged_images_are_refused(change):
    sent = message(colours(), "rgb8")
    vars(sent).update(change)

    with pytest.raises(BadMessage, match=r"damaged images: 6x\d rgb8 with rows of"):
        images.to_rgb(sent, 4, 6)


@pytest.mark.parametrize("encoding", ["rgb8", "mono8", "16UC1", "32FC1", "rgba8"])
def test_filling_and_viewing_are_inverse(encoding):
    blank = message(colours(), encoding)
    sent = np.array(images.view(blank) if encoding == "rgb8" else np.ones((3, 5, 1), np.uint8))
    dtype = {"16UC1": np.uint16, "32FC1": np.float32}.get(encoding, np.uint8)
    channels = {"rgb8": 3, "rgba8": 4}.get(encoding, 1)
    sent = np.arange(3 * 5 * channels).reshape(3, 5, channels).astype(dtype)

    images.fill(blank, sent, encoding)

    assert isinstance(blank.data, array.array)
    np.testing.assert_array_equal(images.view(blank), sent)


@pytest.mark.parametrize(
    ("pixels", "encoding", "what"),
    [
        (np.zeros((2, 2, 3)), "rgb8", "rgb8 needs uint8 of shape"),
        (np.zeros((2, 2), np.uint8), "rgb8", "rgb8 needs uint8 of shape"),
        (np.zeros((2, 2), np.uint8), "16UC1", "16UC1 needs uint16"),
        (np.zeros((2, 2), np.uint8), "jpeg", "unknown encoding 'jpeg'"),
    ],
)
def test_filling_with_the_wrong_array_is_an_error(pixels, encoding, what):
    with pytest.raises(ValueError, match=what):
        images.fill(message(colours(), "rgb8"), pixels, encoding)


class TestCompressed:
    """``CompressedImage``, decoded by OpenCV."""

    def packed(self, pixels, suffix, form, header=b""):
        cv2 = pytest.importorskip("cv2", reason="pip install opencv-python-headless")
        done, data = cv2.imencode(suffix, pixels)
        assert done
        return SimpleNamespace(format=form, data=array.array("B", header + data.tobytes()))

    def test_png_is_exact_and_rgb(self):
        rgb = colours()
        sent = self.packed(rgb[..., ::-1], ".png", "rgb8; png compressed bgr8")

        np.testing.assert_array_equal(images.to_rgb(sent, 4, 6), rgb)

    def test_jpeg_is_close(self):
        rgb = np.full((48, 64, 3), (200, 100, 50), np.uint8)
        got = images.to_rgb(self.packed(rgb[..., ::-1], ".jpg", "jpeg"), 48, 64)

        assert np.abs(got.astype(int) - rgb).max() <= 4

    @pytest.mark.parametrize("form", ["mono8; jpeg compressed ", "jpeg"])
    def test_a_compressed_image_without_colours_is_refused(self, form):
        grey = self.packed(np.full((48, 64), 90, np.uint8), ".jpg", form)

        with pytest.raises(BadMessage, match="sends mono8 images, which have no colours"):
            images.to_rgb(grey, 48, 64)
        assert (images.to_rgb(grey, 48, 64, grey=True) == 90).all()

    def test_compressed_depth(self):
        depth = np.array([[0, 1500]], np.uint16)
        sent = self.packed(depth, ".png", "16UC1; compressedDepth png", header=bytes(12))

        np.testing.assert_allclose(images.to_depth(sent, 1, 2), [[np.nan, 1.5]], rtol=1e-6)

    @pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "mono8"])
    @pytest.mark.parametrize(("form", "off"), [("png", 0), ("jpeg", 4)])
    def test_colours_come_back(self, encoding, form, off):
        pytest.importorskip("cv2", reason="pip install opencv-python-headless")
        rgb = np.full((48, 64, 3), (200, 100, 50), np.uint8)
        sent = {"bgr8": rgb[..., ::-1], "mono8": rgb[..., 0]}.get(encoding, rgb)
        sent = np.dstack([sent, sent[..., 0]]) if encoding == "rgba8" else sent
        wanted = rgb[..., :1] if encoding == "mono8" else rgb
        message = images.fill_compressed(SimpleNamespace(), sent, encoding, form)

        assert message.format == f"{encoding}; {form} compressed bgr8"
        assert type(message.data) is array.array, "others are converted byte by byte"
        assert len(message.data) < rgb.size
        got = images.to_rgb(message, 48, 64, grey=encoding == "mono8")
        assert np.abs(got.astype(int) - wanted).max() <= off

    def test_depth_comes_back(self):
        pytest.importorskip("cv2", reason="pip install opencv-python-headless")
        depth = np.array([[0, 1500]], np.uint16)
        message = images.fill_compressed(SimpleNamespace(), depth, "16UC1", "png")

        np.testing.assert_allclose(images.to_depth(message, 1, 2), [[np.nan, 1.5]], rtol=1e-6)

    @pytest.mark.parametrize(
        ("pixels", "encoding", "form", "what"),
        [
            (colours(), "rgb8", "gif", "unknown form 'gif'; there are jpeg, png"),
            (colours(), "bgra8", "png", r"bgra8 needs uint8 of shape \(4, 6, 4\)"),
            (np.ones((2, 2), np.uint16), "16UC1", "jpeg", "jpeg cannot hold 16UC1; png can"),
            (np.ones((2, 2), np.float32), "32FC1", "png", "png cannot hold 32FC1; png can"),
        ],
    )
    def test_what_cannot_be_packed_is_refused(self, pixels, encoding, form, what):
        with pytest.raises(ValueError, match=what):
            images.fill_compressed(SimpleNamespace(), pixels, encoding, form)

    def test_a_compressed_image_has_a_size_too(self):
        with pytest.raises(BadMessage, match="sends 6x4 images, the embodiment says 6x8"):
            images.to_rgb(self.packed(colours(), ".png", "png"), 8, 6)

    @pytest.mark.parametrize("data", [b"", b"no image"])
    def test_what_cannot_be_decoded_is_named(self, data):
        pytest.importorskip("cv2", reason="pip install opencv-python-headless")
        sent = SimpleNamespace(format="jpeg", data=array.array("B", data))

        with pytest.raises(
            BadMessage, match=rf"\('jpeg', {len(data)} bytes\) that cannot be decoded"
        ):
            images.to_rgb(sent, 4, 6)

    def test_other_depth_formats_are_refused(self):
        pytest.importorskip("cv2", reason="pip install opencv-python-headless")
        sent = SimpleNamespace(format="32FC1; compressedDepth png", data=array.array("B", b"x"))

        with pytest.raises(BadMessage, match="only 16UC1 is understood"):
            images.to_depth(sent, 4, 6)

    def test_without_opencv_the_message_says_what_to_install(self, monkeypatch):
        monkeypatch.setitem(__import__("sys").modules, "cv2", None)
        sent = SimpleNamespace(format="jpeg", data=array.array("B", b"x"))

        with pytest.raises(LoadFailed, match="OpenCV is not installed") as caught:
            images.to_rgb(sent, 4, 6)

        assert caught.value.next.startswith("pip install opencv-python-headless")
        with pytest.raises(LoadFailed, match="compressed images are to be sent, and OpenCV"):
            images.fill_compressed(SimpleNamespace(), colours(), "rgb8")
