"""Config checks before anything is built, and their messages."""

from __future__ import annotations

import subprocess
import sys

import pytest
from fluxvla_metaworld import environment as module
from fluxvla_metaworld.environment import MetaWorldEnvironment
from fluxvla_metaworld.expert import MetaWorldExpert
from fluxvla_metaworld.tasks import INSTRUCTIONS, MT10, choose_tasks

from fluxvla_core import build_environment_from_cfg, build_policy_from_cfg
from fluxvla_core.errors import ConfigError, MissingPlugin, RunFailed
from fluxvla_core.operators import EmbodimentSpec


def test_the_spec_is_known_before_a_scene_is_built():
    spec = MetaWorldEnvironment(render="reference", height=96, width=128).spec
    body = spec.embodiment
    assert (body.dim, body.state_dim, body.rate_hz) == (4, 4, 80.0)
    assert (body.action_mode, body.frame, body.rotation) == ("delta", "world", "none")
    assert (body.joints[3].open, body.joints[3].closed) == (-1.0, 1.0)
    assert [(c.name, c.height, c.width) for c in body.cameras] == [("corner2", 96, 128)]
    assert EmbodimentSpec.from_dict(body.to_dict()) == body
    assert len(spec.tasks) == 50
    assert {task.max_steps for task in spec.tasks} == {500}
    assert spec.details["render"] == "reference", "a report states how images are drawn"
    assert spec.keep_together


def test_configs_name_the_environment_and_its_expert():
    table = {"type": "MetaWorldEnvironment", "tasks": ["reach-v3"], "max_steps": 200}
    made = build_environment_from_cfg(table)
    assert [(t.name, t.max_steps) for t in made.spec.tasks] == [("reach-v3", 200)]
    assert isinstance(build_policy_from_cfg({"type": made.expert}), MetaWorldExpert)


def test_sets_of_tasks_have_names():
    assert choose_tasks("MT10") == MT10
    assert choose_tasks("MT50") == tuple(INSTRUCTIONS)
    assert choose_tasks(["push-v3", "reach-v3"]) == ("push-v3", "reach-v3")
    assert len(set(INSTRUCTIONS.values())) == 50, "each task has an instruction of its own"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tasks": "MT25"}, "'MT25' is not a set of tasks; there are MT10, MT50"),
        ({"tasks": ["juggle-v3"]}, "Meta-World has no task 'juggle-v3'; it has assembly-v3, "),
        ({"tasks": []}, "tasks must name each task once"),
        ({"tasks": ["push-v3", "push-v3"]}, "tasks must name each task once"),
        ({"cameras": ("front",)}, "no camera 'front'; they have corner, corner2"),
        ({"height": 8}, "images of 8x224 are too small"),
        ({"render": "nice"}, "render 'nice' is unknown; choose one of cheap, coarse, reference"),
        ({"max_steps": 501}, "max_steps must be 1 to 500, got 501"),
    ],
)
def test_impossible_values_are_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        MetaWorldEnvironment(**arguments)


def test_without_meta_world_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setattr(module, "is_installed", lambda: False)
    with pytest.raises(MissingPlugin, match="Meta-World is not installed") as caught:
        MetaWorldEnvironment().reset(0, "push-v3")
    assert "pip install 'fluxvla-metaworld[metaworld]'" in str(caught.value)


def test_a_meta_world_that_cannot_be_imported_is_named(monkeypatch):
    monkeypatch.setattr(module, "is_installed", lambda: True)
    monkeypatch.setattr(module, "use_egl", lambda: None)
    monkeypatch.setitem(sys.modules, "metaworld.env_dict", None)
    monkeypatch.setitem(sys.modules, "metaworld", None)
    with pytest.raises(RunFailed, match="Meta-World is installed and cannot be imported"):
        MetaWorldEnvironment().reset(0, "push-v3")


def test_an_expert_acts_in_meta_world_only():
    expert = MetaWorldExpert()
    with pytest.raises(ConfigError, match="in MetaWorldEnvironment only, not in object"):
        expert.enter(object())
    with pytest.raises(ConfigError, match="does not know its environment"):
        expert.predict_action({})


def test_importing_imports_no_simulator():
    code = (
        "import sys, fluxvla_metaworld.environment, fluxvla_metaworld.expert\n"
        "print([m for m in ('mujoco', 'metaworld', 'gymnasium', 'torch') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr
