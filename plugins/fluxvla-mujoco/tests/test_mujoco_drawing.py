"""Drawing MuJoCo's scenes: upright, cheap, coarse, and with a message where nothing can draw."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from fluxvla_mujoco import drawing
from fluxvla_mujoco.drawing import Drawing, check_render, coarsen, set_render

from fluxvla_core.errors import ConfigError, RunFailed


def model():
    """A finely tessellated red ball above a blue floor, seen from the side."""
    mujoco = pytest.importorskip("mujoco")
    angles = np.linspace(0, np.pi, 40)[:, None], np.linspace(0, 2 * np.pi, 40)
    x, y = np.sin(angles[0]) * np.cos(angles[1]), np.sin(angles[0]) * np.sin(angles[1])
    z = np.cos(angles[0]) * np.ones_like(x)
    points = 0.1 * np.stack([x, y, z], -1).reshape(-1, 3)
    text = " ".join(f"{v:.5f}" for v in points.ravel())
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><asset><mesh name="ball" vertex="{text}"/></asset><worldbody>
        <light pos="0 0 2"/><camera name="side" pos="0 -1 0.2" xyaxes="1 0 0 0 0 1"/>
        <geom type="plane" size="2 2 0.1" rgba="0 0 1 1"/>
        <body pos="0 0 0.3"><freejoint/><geom type="mesh" mesh="ball" rgba="1 0 0 1"/></body>
        </worldbody></mujoco>"""
    )


def draw(made, render, size=(48, 64)):
    import mujoco

    data = mujoco.MjData(made)
    mujoco.mj_forward(made, data)
    drawn = Drawing(made, render)
    image = drawn.image(data, "side", *size)
    again = drawn.image(data, "side", *size)
    np.testing.assert_array_equal(image, again)
    assert image.base is None, "an image of its own"
    drawn.close()
    drawn.close()
    return image


@pytest.fixture(autouse=True)
def _egl(monkeypatch):
    if sys.platform == "linux":
        monkeypatch.setenv("MUJOCO_GL", "egl")


def test_images_are_upright_and_of_the_size_that_is_asked_for():
    image = draw(model(), "cheap")
    assert (image.shape, image.dtype) == ((48, 64, 3), np.uint8)
    red = (image[..., 0] > 60) & (image[..., 2] < 30)
    assert red[:24].sum() > red[24:].sum() > -1
    assert red[10:24, 20:44].any(), "the ball is in the upper half, the floor in the lower"
    assert image[40, 32, 2] > image[40, 32, 0]


def test_coarse_images_show_the_same_with_fewer_faces_and_leave_the_physics_alone():
    fine, coarse = model(), model()
    expected = draw(fine, "cheap").astype(int)
    vertices, graph = coarse.mesh_vert.copy(), coarse.mesh_graph.copy()
    seen = draw(coarse, "coarse").astype(int)
    assert coarse.mesh_facenum[0] < 0.95 * fine.mesh_facenum[0]
    np.testing.assert_array_equal(coarse.mesh_vert, vertices)
    np.testing.assert_array_equal(coarse.mesh_graph, graph)
    assert np.abs(seen - expected).mean() < 2
    coarsen(coarse, 0.03)
    assert 20 < coarse.mesh_facenum[0] < 0.3 * fine.mesh_facenum[0]
    kept = int(coarse.mesh_facenum[0])
    assert (np.diff(np.sort(coarse.mesh_face[:kept], axis=1), axis=1) > 0).all()
    coarsen(coarse, 0.05)
    assert coarse.mesh_facenum[0] == kept, "a mesh of few faces is left as it is"


def test_only_the_reference_keeps_the_models_quality():
    def quality(render):
        made = SimpleNamespace(quality=SimpleNamespace(shadowsize=4096, offsamples=4))
        set_render(SimpleNamespace(vis=made, nmesh=0), render)
        return made.quality.shadowsize, made.quality.offsamples

    assert quality("reference") == (4096, 4)
    assert quality("cheap") == quality("coarse") == (0, 0)


def test_an_unknown_quality_is_answered_with_those_there_are():
    with pytest.raises(
        ConfigError, match="render 'nice' is unknown; choose one of cheap, coarse, reference"
    ):
        check_render("nice")


def test_a_renderer_that_is_missing_is_named(monkeypatch):
    def missing(name):
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(drawing.sys, "platform", "linux")
    monkeypatch.setattr(drawing.ctypes, "CDLL", missing)
    monkeypatch.delitem(sys.modules, "mujoco", raising=False)
    with pytest.raises(RunFailed, match=r"libEGL\.so\.1 cannot be loaded") as caught:
        drawing.use_egl()
    assert "apt-get install -y libegl1" in str(caught.value)
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    drawing.use_egl()


def test_a_context_that_cannot_be_made_is_no_traceback(monkeypatch):
    made = model()
    import mujoco

    def refuse(*arguments):
        raise RuntimeError("no display")

    monkeypatch.setattr(mujoco, "Renderer", refuse)
    with pytest.raises(RunFailed, match=r"no OpenGL context could be made \(no display\)"):
        draw(made, "cheap")


def test_importing_it_imports_no_simulator():
    code = "import sys, fluxvla_mujoco.drawing; print('mujoco' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "False", done.stderr


def test_what_draws_has_a_name():
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><camera name='c' pos='0 0 2'/><geom size='1'/></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    drawing.use_egl()
    drawn = drawing.Drawing(model, "cheap")
    drawn.image(data, "c", 16, 16)
    drawn.close()
    assert drawing.drawn_by().count(": ") == 1
