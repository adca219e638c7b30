"""``ResizeImagesWithPad`` against Pillow and against bilinear interpolation written out."""

from __future__ import annotations

import numpy as np
import pytest

from fluxvla_core.build import build_transform_from_cfg
from fluxvla_core.data.transforms.images import ResizeImagesWithPad
from fluxvla_core.errors import ConfigError, DataError


def random_image(height, width, seed=0):
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (3, height, width), np.uint8)


def run(images, height=20, width=24, **settings):
    table = {"type": "ResizeImagesWithPad", "height": height, "width": width, **settings}
    return build_transform_from_cfg(table)({"images": images})["images"]


@pytest.mark.parametrize(
    ("size", "fitted", "corner"),
    [((48, 64), (18, 24), (1, 0)), ((41, 30), (20, 14), (0, 5)), ((10, 12), (20, 24), (0, 0))],
)
def test_bytes_are_pillows(size, fitted, corner):
    image = random_image(*size)
    found = run([image])
    pillow = pytest.importorskip("PIL.Image")
    small = pillow.fromarray(image.transpose(1, 2, 0)).resize(
        fitted[::-1], pillow.Resampling.BILINEAR
    )
    expected = np.zeros((3, 20, 24), np.uint8)
    (top, left), (rows, columns) = corner, fitted
    expected[:, top : top + rows, left : left + columns] = np.asarray(small).transpose(2, 0, 1)
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("size", [(48, 64), (41, 30), (10, 12)])
def test_linear_is_torchs_interpolation_without_rounding(size):
    torch = pytest.importorskip("torch")
    image = random_image(*size)
    found = run([image], interpolation="linear")
    ratio = max(size[1] / 24, size[0] / 20)
    rows, columns = int(size[0] / ratio), int(size[1] / ratio)
    small = torch.nn.functional.interpolate(
        torch.from_numpy(image)[None].float(), size=(rows, columns), mode="bilinear"
    )[0].numpy()
    top, left = (20 - rows) // 2, (24 - columns) // 2
    assert found.dtype == np.float32
    inside = found[:, top : top + rows, left : left + columns]
    # float32 places within 64 pixels, neighbours that differ by 255.
    np.testing.assert_allclose(inside, small, rtol=0, atol=64 * 2**-23 * 255)
    assert found.sum() == pytest.approx(inside.sum(), rel=1e-6)


def test_cameras_of_several_sizes_become_one_array():
    found = run([random_image(48, 64), random_image(41, 30, 1)])
    assert found.shape == (6, 20, 24)
    np.testing.assert_array_equal(found[3:], run([random_image(41, 30, 1)]))


def test_an_image_of_that_size_is_left_as_it_is():
    image = random_image(20, 24)
    for interpolation in ("antialias", "linear"):
        found = run([image], interpolation=interpolation)
        assert found.dtype == np.uint8
        np.testing.assert_array_equal(found, image)


def test_what_remains_is_filled():
    found = run([random_image(41, 30)], pad_value=9)
    assert (found[:, :, :5] == 9).all()
    assert (found[:, :, 19:] == 9).all()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"height": 0}, "0 x 24 is not a size"),
        ({"interpolation": "area"}, "'area' is not one of antialias, linear"),
        ({"pad_value": 256}, "pad_value 256 is not in 0..255"),
    ],
)
def test_settings_that_mean_nothing(settings, words):
    with pytest.raises(ConfigError, match=words):
        ResizeImagesWithPad(**{"height": 20, "width": 24, **settings})


def test_images_that_cannot_be_fitted():
    with pytest.raises(DataError, match="takes uint8 images, got float32"):
        run([random_image(48, 64).astype(np.float32)])
    with pytest.raises(DataError, match="1 x 64 pixels has no pixel left in 20 x 24"):
        run([random_image(1, 64)])
