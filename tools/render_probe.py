"""Render one MuJoCo frame without a display; exit 0 when it shows what it should.

Runs in the environment that will render, as a program of its own: a missing libEGL can end the
process, and MUJOCO_GL is read when mujoco is imported.
"""

from __future__ import annotations

import sys

SCENE = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <geom type="sphere" size=".4" rgba="1 0 0 1"/>
    <camera name="front" pos="0 -2 0" xyaxes="1 0 0 0 0 1"/>
  </worldbody>
</mujoco>
"""


def main() -> int:
    import mujoco

    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 32, 32) as renderer:
        renderer.update_scene(data, camera="front")
        red, green, blue = (int(v) for v in renderer.render()[16, 16])
    if not red > 2 * max(green, blue, 1):
        print(f"the middle of a red sphere came out as rgb({red}, {green}, {blue})")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
