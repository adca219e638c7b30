"""Golden file of the operations on images that OpenVLA's code leaves to TensorFlow.

In an environment with tensorflow-cpu, safetensors and numpy, from the root of the repository:

    PYTHONPATH=. python plugins/fluxvla-openvla/tests/oracles/make_tensorflow.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tensorflow as tf
from safetensors.numpy import save_file

from tests.oracles import fill


def main() -> None:
    """Write ``golden/tensorflow.safetensors``."""
    picture = fill.integers("picture", (48, 64, 3), 256).astype(np.uint8)
    smooth = tf.image.resize(picture, (40, 40)).numpy().astype(np.uint8)
    small = tf.image.resize(smooth, (28, 28), method="lanczos3", antialias=True)
    small = tf.cast(tf.clip_by_value(tf.round(small), 0, 255), tf.uint8)
    unit = tf.image.convert_image_dtype(small, tf.float32)
    side = float(np.sqrt(0.9))
    begin = (1 - side) / 2
    arrays = {"smooth": smooth, "lanczos": small.numpy()}
    for name, top, left in (("middle", begin, begin), ("corner", 0.01, 0.04)):
        box = [[top, left, top + side, left + side]]
        cropped = tf.image.crop_and_resize(unit[None], box, [0], (28, 28))[0]
        arrays[name] = _bytes(cropped)
    changed = tf.clip_by_value(tf.image.adjust_brightness(unit, 0.1), 0, 1)
    changed = tf.clip_by_value(tf.image.adjust_contrast(changed, 1.15), 0, 1)
    changed = tf.clip_by_value(tf.image.adjust_saturation(changed, 0.85), 0, 1)
    arrays["jittered"] = _bytes(tf.clip_by_value(tf.image.adjust_hue(changed, -0.04), 0, 1))
    file = Path(__file__).parents[1] / "golden" / "tensorflow.safetensors"
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    save_file(arrays, file, {"tensorflow": tf.__version__})


def _bytes(image: tf.Tensor) -> np.ndarray:
    clipped = tf.clip_by_value(image, 0, 1)
    return tf.image.convert_image_dtype(clipped, tf.uint8, saturate=True).numpy()


if __name__ == "__main__":
    main()
