"""Names and numbers of a robot as a policy of LeRobot has them, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fluxvla_core import Camera, EmbodimentSpec, Observation
from fluxvla_core.errors import ConfigError, DataError, SpecMismatch
from fluxvla_lerobot.files import STATE, Described

Array = npt.NDArray[np.float64]
_DEGREES = 180.0 / np.pi


@dataclass(frozen=True)
class Columns:
    """Which columns of a robot's state and actions the policy's are, and in what unit.

    Args:
        state: for each of the policy's state columns the robot's.
        state_scale: what the robot's values are multiplied by for the policy.
        action: for each of the robot's action columns the policy's.
        action_scale: what the policy's values are multiplied by for the robot.
        width: of the robot's state.
    """

    state: npt.NDArray[np.intp]
    state_scale: Array
    action: npt.NDArray[np.intp]
    action_scale: Array
    width: int

    def states(self, qpos: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """``(S,)`` of the robot -> ``(S',)`` of the policy.

        Raises:
            DataError: ``qpos`` has another width.
        """
        if np.shape(qpos) != (self.width,):
            raise DataError(
                f"the observation's qpos has shape {np.shape(qpos)}; ({self.width},) is expected"
            )
        return np.asarray(np.asarray(qpos)[self.state] * self.state_scale, dtype=np.float32)

    def actions(self, chunk: Array) -> Array:
        """``(T, D)`` of the policy -> ``(T, D)`` of the robot, float64."""
        return np.asarray(chunk, dtype=np.float64)[:, self.action] * self.action_scale


def plain_columns(described: Described) -> Columns:
    """The columns of a robot that is not known: as they come."""
    width = described.state_dim or 0
    state, action = np.arange(width), np.arange(described.action_dim)
    return Columns(state, np.ones(width), action, np.ones(len(action)), width)


def columns_for(
    robot: EmbodimentSpec,
    described: Described,
    state: Sequence[str] | None = None,
    actions: Sequence[str] | None = None,
    degrees: bool = False,
) -> Columns:
    """The columns of ``robot``.

    Args:
        state: names of the robot's joints in the order of the policy's state; all of the robot's,
            in its order, by default.
        actions: likewise of the policy's actions; each of the robot's joints has to be there.
        degrees: the policy has degrees where the robot has radians.

    Raises:
        SpecMismatch: the robot has no such joint, or the widths differ.
    """
    own_states, own_actions = robot.state_names, robot.joint_names
    wanted_states = tuple(own_states if state is None else state)
    wanted_actions = tuple(own_actions if actions is None else actions)
    for key, wanted, own in (
        ("state", wanted_states, own_states),
        ("actions", wanted_actions, own_actions),
    ):
        unknown = [name for name in wanted if name not in own]
        if unknown or len(set(wanted)) != len(wanted):
            what = f"has no joint {unknown[0]!r}" if unknown else "has each joint once"
            raise SpecMismatch(
                f"{key}: {robot.name} {what}; it has {', '.join(own)}; "
                f"the config says {', '.join(wanted)}"
            )
    if described.state_dim is not None and len(wanted_states) != described.state_dim:
        raise SpecMismatch(
            f"the policy takes {described.state_dim} state values ({STATE}); {robot.name} has "
            f"{len(wanted_states)}: {', '.join(wanted_states)}",
            next=None if state else "state = [...]: the joints that it takes, in its order",
        )
    if len(wanted_actions) != described.action_dim or len(wanted_actions) != robot.dim:
        raise SpecMismatch(
            f"the policy gives {described.action_dim} values for an action; {robot.name} takes "
            f"{robot.dim}: {', '.join(own_actions)}"
            + (f"; actions names {len(wanted_actions)}" if actions is not None else "")
        )
    state_joints = {joint.name: joint for joint in robot.state_joints or robot.joints}
    turns = np.array([degrees and state_joints[name].unit == "rad" for name in wanted_states])
    back = np.array([degrees and joint.unit == "rad" for joint in robot.joints])
    return Columns(
        state=np.array([own_states.index(name) for name in wanted_states], dtype=np.intp),
        state_scale=np.where(turns, _DEGREES, 1.0),
        action=np.array([wanted_actions.index(name) for name in own_actions], dtype=np.intp),
        action_scale=np.where(back, 1.0 / _DEGREES, 1.0),
        width=robot.state_dim,
    )


def cameras_for(
    described: Described, renamed: Mapping[str, str], left_out: Sequence[str]
) -> dict[str, str]:
    """The policy's feature -> the robot's camera.

    Args:
        renamed: the policy's camera -> the robot's.
        left_out: cameras of the policy that the robot lacks.

    Raises:
        ConfigError: the policy has no such camera, or two of its cameras are one of the robot's.
    """
    own = {camera: feature for feature, camera in described.cameras.items()}
    for key, names in (("cameras", list(renamed)), ("left_out", list(left_out))):
        unknown = [name for name in names if name not in own]
        if unknown:
            raise ConfigError(
                f"LeRobotPolicy: {key}: the policy has no camera {unknown[0]!r}; it has "
                f"{', '.join(own) or 'none'}"
            )
    found = {
        feature: renamed.get(camera, camera)
        for camera, feature in own.items()
        if camera not in left_out
    }
    taken = list(found.values())
    twice = sorted({name for name in taken if taken.count(name) > 1})
    if twice:
        raise ConfigError(f"LeRobotPolicy: two of the policy's cameras are {twice[0]!r}")
    return found


def camera_images(
    observation: Observation, cameras: Mapping[str, str], trained: Mapping[str, Camera]
) -> dict[str, npt.NDArray[np.uint8]]:
    """The policy's features: feature -> ``(H, W, 3)`` uint8.

    Args:
        cameras: feature -> the robot's camera.
        trained: cameras of the embodiment that the policy was trained for; larger images of the
            same view are scaled down to theirs.

    Raises:
        DataError: a camera is missing, or has another size than it can be scaled from.
    """
    found = {}
    for feature, name in cameras.items():
        if name not in observation["images"]:
            raise DataError(
                f"the observation has no image of {name!r}; it has "
                f"{', '.join(observation['images']) or 'none'}"
            )
        image = np.asarray(observation["images"][name])
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise DataError(
                f"the image of {name} is {image.shape} {image.dtype}; (H, W, 3) uint8 is expected"
            )
        camera = trained.get(name)
        if camera is not None and image.shape[:2] != (camera.height, camera.width):
            image = _scaled(image, camera)
        found[feature] = image
    return found


def check_sizes(
    described: Described, cameras: Mapping[str, str], sizes: Mapping[str, tuple[int, int]]
) -> None:
    """Refuse images of another size than a policy was trained on that takes them as they are.

    Args:
        cameras: feature -> the robot's camera.
        sizes: the robot's camera -> height and width.

    Raises:
        SpecMismatch: names the camera and both sizes.
    """
    if described.kind not in AS_THEY_ARE:
        return
    for feature, name in cameras.items():
        expected, found = described.sizes[feature], sizes.get(name)
        if found is not None and found != expected:
            raise SpecMismatch(
                f"camera {name} gives {found[0]} x {found[1]} images; the policy was trained on "
                f"{expected[0]} x {expected[1]}, and takes them as they are",
                next=f"height = {expected[0]} and width = {expected[1]} in the evaluation; or an "
                "embodiment whose cameras have the size of the training data",
            )


AS_THEY_ARE = frozenset({"act", "diffusion", "multi_task_dit", "tdmpc", "vqbet"})
"""Types of LeRobot whose files state the size of the images that they were trained on. The others
bring images to a size of their own, and keep the sizes of the model that they began from."""


def _scaled(image: npt.NDArray[np.uint8], camera: Camera) -> npt.NDArray[np.uint8]:
    import cv2

    height, width = image.shape[:2]
    if abs(width * camera.height - camera.width * height) > 0.01 * height * camera.width:
        raise DataError(
            f"camera {camera.name} gives {height} x {width} images; the policy was trained on "
            f"{camera.height} x {camera.width}: another view"
        )
    size = (camera.width, camera.height)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
