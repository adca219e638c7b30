"""The page's FAQ: a new operator alone, driven by an existing runner.

Two arms with other topics and no runner of their own: the operator has the full contract, so
``AlohaInferenceRunner`` drives it. Only what the runner needs is here: an embodiment and six calls.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import numpy.typing as npt

from fluxvla_core import Camera, EmbodimentSpec, Frame, Joint
from fluxvla_core.control.clock import SimulatedClock
from fluxvla_core.errors import NotReady, Rejected

SIZE = 32
RATE_HZ = 50.0


def _arm(side: str) -> tuple[Joint, ...]:
    joints = tuple(Joint(f"{side}_joint_{n}", "rad", -3.0, 3.0, 2.0, 10.0) for n in range(1, 7))
    jaw = Joint(f"{side}_jaw", "normalized", 0, 1, 2.0, 20.0, kind="gripper", open=1.0, closed=0.0)
    return (*joints, jaw)


class MyDualArmOperator:
    """Two arms in memory behind the operator contract.

    Args:
        img_front_topic, joint_state_topic, joint_cmd_topic: where a real one would listen and
            speak; the page's configuration names them.
    """

    api: ClassVar[str] = "1.0"

    def __init__(self, img_front_topic: str, joint_state_topic: str, joint_cmd_topic: str) -> None:
        self.topics = img_front_topic, joint_state_topic, joint_cmd_topic
        self.embodiment = EmbodimentSpec(
            name="mydualarm",
            joints=(*_arm("left"), *_arm("right")),
            cameras=(Camera("cam_front", SIZE, SIZE),),
            rate_hz=RATE_HZ,
        )
        # Time stands still between commands; a real robot has no clock of its own.
        self.clock = SimulatedClock()
        self._pose: npt.NDArray[np.float64] | None = None

    def connect(self) -> None:
        """Open the connection: here, put the arms where they begin."""
        self._pose = np.zeros(self.embodiment.dim)

    def get_frame(self) -> Frame:
        """The newest reading."""
        if self._pose is None:
            raise NotReady("not connected", next="call connect() first")
        now = self.clock.now()
        image = np.full((SIZE, SIZE, 3), 90, np.uint8)
        return Frame(self._pose.copy(), {"cam_front": image}, {"state": now, "cam_front": now})

    def send_action(self, action: npt.NDArray[np.float64]) -> None:
        """Command both arms; one control period passes."""
        target = np.array(action, dtype=np.float64)
        if target.shape != (self.embodiment.dim,) or not np.isfinite(target).all():
            raise Rejected(f"{self.embodiment.dim} finite numbers are expected, got {action}")
        for joint, value in zip(self.embodiment.joints, target, strict=True):
            if not joint.lower <= value <= joint.upper:
                raise Rejected(f"{joint.name} cannot go to {value:g}")
        if self._pose is None:
            raise NotReady("not connected", next="call connect() first")
        self._pose = target
        self.clock.advance(1.0 / RATE_HZ)

    def stop(self) -> None:
        """Hold: the arms are where they were last told to be."""

    def close(self) -> None:
        """Close the connection."""
        self._pose = None
