"""Attributes of kits that had another name."""

from __future__ import annotations

import pytest

from fluxvla_core.testing import EnvironmentConformance, ModelConformance, TransformConformance


@pytest.mark.parametrize("kit", [EnvironmentConformance, ModelConformance, TransformConformance])
def test_picture_is_deprecated_and_still_works(kit):
    with pytest.warns(DeprecationWarning, match="Own.picture is deprecated, use image_size"):
        own = type("Own", (kit,), {"picture": (20, 30)})
    assert own.image_size == (20, 30)
    assert kit.image_size != (20, 30)
