from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fluxvla_core import build_transform_from_cfg
from fluxvla_core.data.transforms.images import (
    CropImages,
    NormalizeImages,
    ResizeImages,
    SimpleNormalizeImages,
    join_planes,
    split_images,
    stack_images,
)
from fluxvla_core.errors import ConfigError, DataError

MEANS = [123.515625, 116.04492188, 103.59375]
STDS = [58.27148438, 57.02636719, 57.27539062]


def random_image(seed=0, height=12, width=16):
    return np.random.default_rng(seed).integers(0, 256, (3, height, width), dtype=np.uint8)


def frozen(*images):
    for image in images:
        image.flags.writeable = False
    return list(images)


@pytest.mark.parametrize("interpolation", ["linear", "area"])
def test_resize_stretches_every_camera_and_keeps_the_dtype(interpolation):
    cfg = {"type": "ResizeImages", "height": 6, "width": 8, "interpolation": interpolation}
    images = frozen(random_image(0), random_image(1, 20, 10))
    out = build_transform_from_cfg(cfg)({"images": images, "other": 1})
    assert out["images"].shape == (6, 6, 8)
    assert out["images"].dtype == np.uint8
    assert out["other"] == 1
    again = ResizeImages(6, 8, interpolation)({"images": [images[1]]})["images"]
    np.testing.assert_array_equal(out["images"][3:], again)


def test_resize_to_half_by_area_is_the_mean_of_four():
    image = random_image().astype(np.float32)
    out = ResizeImages(6, 8, "area")({"images": [image]})["images"]
    np.testing.assert_allclose(out, image.reshape(3, 6, 2, 8, 2).mean((2, 4)), rtol=1e-5)


def test_resize_to_the_same_size_changes_nothing():
    images = frozen(random_image(0), random_image(1))
    out = ResizeImages(12, 16)({"images": np.concatenate(images)})["images"]
    np.testing.assert_array_equal(out, np.concatenate(images))


@pytest.mark.parametrize(
    "change",
    [
        lambda image: image,
        lambda image: image[:, 2:9, 3:11],
        lambda image: image[:, ::-1],
        lambda image: image[:, :, ::2],
        lambda image: np.ascontiguousarray(image),
        lambda image: image.astype(np.float32),
    ],
)
def test_joining_planes_is_concatenation_whatever_the_memory_is_like(change):
    """Decoded images are views of (H, W, 3) memory, sometimes read-only or cut."""
    views = [
        np.ascontiguousarray(random_image(i).transpose(1, 2, 0)).transpose(2, 0, 1) for i in (0, 1)
    ]
    images = frozen(*(change(view) for view in views))
    joined = join_planes(images)
    assert joined.flags.c_contiguous
    assert joined.flags.writeable
    assert joined.dtype == images[0].dtype
    np.testing.assert_array_equal(joined, np.concatenate(images))


@given(top=st.integers(0, 6), left=st.integers(0, 8))
def test_crop_cuts_the_rectangle_out_of_lists_and_arrays(top, left):
    images = frozen(random_image(0), random_image(1))
    crop = CropImages(top, left, 6, 8)
    out = crop({"images": images})["images"]
    for got, image in zip(out, images, strict=True):
        np.testing.assert_array_equal(got, image[:, top : top + 6, left : left + 8])
    stacked = crop({"images": np.concatenate(images)})["images"]
    np.testing.assert_array_equal(stacked, np.concatenate(out))


def test_normalize_uses_each_cameras_group():
    images = frozen(random_image(0), random_image(1))
    cfg = {"type": "NormalizeImages", "means": [MEANS, [0, 0, 0]], "stds": [STDS, [1, 1, 1]]}
    out = build_transform_from_cfg(cfg)({"images": images})["images"]
    assert out.dtype == np.float32
    first = (images[0] - np.array(MEANS).reshape(3, 1, 1)) / np.array(STDS).reshape(3, 1, 1)
    np.testing.assert_allclose(out[:3], first, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(out[3:], images[1], rtol=1e-6)


def test_normalize_with_one_group_serves_all_cameras_and_scales_on_request():
    images = frozen(random_image(0), random_image(1))
    out = NormalizeImages([0.5] * 3, [0.25] * 3, scale_to_unit_interval=True)({"images": images})
    expected = (np.concatenate(images) / 255 - 0.5) / 0.25
    np.testing.assert_allclose(out["images"], expected, rtol=1e-5, atol=1e-6)


def test_simple_normalisation_maps_to_minus_one_and_one():
    image = np.stack([np.full((2, 2), v, np.uint8) for v in (0, 128, 255)])
    out = SimpleNormalizeImages()({"images": frozen(image)})["images"]
    assert out.dtype == np.float32
    np.testing.assert_allclose(out[:, 0, 0], [-1, 128 / 255 * 2 - 1, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("cfg", "message"),
    [
        ({"type": "ResizeImages", "height": 0, "width": 8}, "ResizeImages: 0 x 8 is not a size"),
        (
            {"type": "ResizeImages", "height": 8, "width": 8, "interpolation": "cubic"},
            "interpolation 'cubic' is not one of linear, area",
        ),
        (
            {"type": "CropImages", "top": -1, "left": 0, "height": 2, "width": 2},
            "CropImages: top -1, left 0, height 2, width 2 is not a rectangle",
        ),
        (
            {"type": "NormalizeImages", "means": [1, 2], "stds": [1, 2]},
            r"means must be 3 numbers, or 3 for each camera; got shape \(2,\)",
        ),
        (
            {"type": "NormalizeImages", "means": [MEANS, MEANS], "stds": STDS},
            "2 groups of means, 1 of stds",
        ),
        ({"type": "NormalizeImages", "means": MEANS, "stds": [1, 0, 1]}, "std must be positive"),
    ],
)
def test_parameters_that_make_no_sense_are_refused(cfg, message):
    with pytest.raises(ConfigError, match=message):
        build_transform_from_cfg(cfg)


def test_groups_that_fit_no_number_of_cameras():
    with pytest.raises(ConfigError) as caught:
        NormalizeImages([MEANS] * 3, [STDS] * 3)({"images": [random_image(), random_image()]})
    assert "3 groups of means and stds, 2 cameras" in str(caught.value)
    assert "give one group for all cameras, or one for each" in str(caught.value)


def test_a_crop_beyond_the_image_is_refused():
    with pytest.raises(DataError, match=r"rows 8:14, columns 0:4 are not in an image of 12 x 16"):
        CropImages(8, 0, 6, 4)({"images": [random_image()]})


def test_wrong_shapes_say_what_is_likely():
    with pytest.raises(DataError, match=r"an image of shape \(12, 16, 3\) is not \(3, height"):
        split_images([random_image().transpose(1, 2, 0)])
    with pytest.raises(DataError, match=r"images of shape \(4, 5, 5\) are not \(3N, height, width"):
        split_images(np.zeros((4, 5, 5), np.uint8))
    with pytest.raises(DataError, match="the sample has no images"):
        split_images([])


def test_different_sizes_need_a_resize():
    with pytest.raises(DataError) as caught:
        stack_images([random_image(), random_image(1, 10, 10)])
    assert "cameras of different sizes cannot be stacked: 12 x 16, 10 x 10" in str(caught.value)
    assert "put ResizeImages before this transform" in str(caught.value)
