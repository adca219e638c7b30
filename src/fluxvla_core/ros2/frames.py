"""Images of a ROS 2 robot's cameras, for its frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from fluxvla_core.ros2 import images
from fluxvla_core.ros2.connection import Connection
from fluxvla_core.ros2.streams import CAMERA, DEPTH, Received, StreamSpec


def pictures(
    specs: Sequence[StreamSpec], chosen: Mapping[str, Received]
) -> tuple[dict[str, npt.NDArray[np.uint8]], dict[str, npt.NDArray[np.float32]]]:
    """The colour and depth images of a frame, by camera name, in fresh arrays.

    Args:
        specs: of any kind; cameras and depths are taken.
        chosen: stream name -> the message to convert.

    Raises:
        BadMessage: an image has another size or encoding than its camera; names stream and topic.
    """
    colours: dict[str, npt.NDArray[np.uint8]] = {}
    depths: dict[str, npt.NDArray[np.float32]] = {}
    for spec in specs:
        if spec.camera is None:
            continue
        message, camera = chosen[spec.name].message, spec.camera
        if spec.kind == CAMERA:
            grey = camera.encoding in images.GREY
            colours[camera.name] = images.to_rgb(
                message, camera.height, camera.width, spec.label, grey
            )
        elif spec.kind == DEPTH:
            depths[camera.name] = images.to_depth(message, camera.height, camera.width, spec.label)
    return colours, depths


def images_after(
    connection: Connection, specs: Sequence[StreamSpec], camera: str, after: float
) -> tuple[list[tuple[float, npt.NDArray[np.uint8]]], int]:
    """The colour images of a camera that are kept and newer than ``after``: see ``RosOperator``.

    None for a camera that has no stream.
    """
    colours = (spec for spec in specs if spec.kind == CAMERA)
    spec = next((s for s in colours if s.camera is not None and s.camera.name == camera), None)
    if spec is None:
        return [], 0
    ring = connection.streams[spec.name].ring
    found = [
        (received.receipt, pictures([spec], {spec.name: received})[0][camera])
        for received in ring.items()
        if received.receipt > after
    ]
    return found, ring.received - ring.duplicates - ring.overtaken
