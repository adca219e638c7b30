"""Entry of the control process: ``python -m fluxvla_core.robot.process MEMORY SETUP [FRAMES]``.

All are file descriptors: of the shared memory, of a pipe with the setup, and the three of
``FrameMemory`` where the operator runs here as a whole.
"""

from __future__ import annotations

import os
import sys

from fluxvla_core.robot.process.control_main import serve
from fluxvla_core.robot.process.frames import FrameChannel, FrameMemory
from fluxvla_core.robot.process.link import Link
from fluxvla_core.robot.process.messages import Kind, error_fields
from fluxvla_core.robot.process.setup import ControlSetup


def main() -> None:
    """Build the robot's commanding side, and serve the main process."""
    memory, setup, *frame_memory = map(int, sys.argv[1:])
    link = Link(memory, control=True)
    with os.fdopen(setup, encoding="utf-8") as pipe:
        text = pipe.read()
    try:
        channel = FrameChannel(FrameMemory(*frame_memory)) if frame_memory else None
        serve(link, ControlSetup.from_json(text), channel)
    except Exception as error:  # noqa: BLE001 - raised in the main process
        link.send(Kind.FAILED, **error_fields(error))


if __name__ == "__main__":
    main()
