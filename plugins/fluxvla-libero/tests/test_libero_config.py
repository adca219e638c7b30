"""Config checks and their messages. Needs no LIBERO."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fluxvla_libero import require
from fluxvla_libero.embodiment import NO_OP
from fluxvla_libero.environment import LiberoEnvironment
from fluxvla_libero.eval_runner import LiberoEvalRunner
from fluxvla_libero.expert import LiberoExpert, plan
from fluxvla_libero.inference_runner import LiberoInferenceRunner
from fluxvla_libero.suites import NUM_STEPS_WAIT, SUITES, max_steps

from fluxvla_core import build_runner_from_cfg
from fluxvla_core.config.load import load_config
from fluxvla_core.errors import ConfigError, MissingPlugin, RunFailed, UsageError
from fluxvla_core.operators import RunContext

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize(
    ("suite", "steps"),
    [
        ("libero_spatial", 220),
        ("libero_object", 280),
        ("libero_goal", 300),
        ("libero_10", 520),
        ("libero_90", 400),
        ("libero_10_swap", 520),
        ("libero_spatial_lan", 220),
    ],
)
def test_each_suite_has_the_step_limit_of_the_standard_protocol(suite, steps):
    assert max_steps(suite) == steps


def test_the_protocol_waits_ten_steps_and_shows_two_cameras_of_224_pixels():
    assert NUM_STEPS_WAIT == 10
    assert NO_OP.tolist() == [0, 0, 0, 0, 0, 0, -1], "still, the gripper open"
    table = LiberoEvalRunner()._environment
    assert table["num_steps_wait"] == 10
    cameras = LiberoEnvironment()._cameras
    assert [(c.name, c.height, c.width) for c in cameras] == [
        ("agentview", 224, 224),
        ("robot0_eye_in_hand", 224, 224),
    ]


def test_an_unknown_suite_is_answered_with_those_there_are():
    with pytest.raises(ConfigError, match="there is no suite 'libero_objects'") as caught:
        max_steps("libero_objects")
    assert "libero_spatial, libero_object, libero_goal, libero_10" in str(caught.value)
    assert len(SUITES) == 5 + 16


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task_suite_name": "libero"}, "task_suite_name is wrong: there is no suite 'libero'"),
        ({"render": "nice"}, "render 'nice' is unknown; choose one of cheap, coarse, reference"),
        ({"num_trials_per_task": 51}, "num_trials_per_task must be 1 to 50, got 51"),
        ({"num_trials_per_task": 0}, "num_trials_per_task must be 1 to 50, got 0"),
        ({"eval_chunk_size": 0}, "eval_chunk_size must be at least 1, got 0"),
        ({"num_steps_wait": -1}, "num_steps_wait must be at least 0, got -1"),
        ({"protocol": "openpi"}, "protocol 'openpi' is unknown; choose one of fluxvla, openvla"),
        ({"max_steps": -5}, "max_steps must be at least 1, got -5"),
        ({"workers": 0}, "workers must be at least 1, got 0"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"resize_size": 8}, "resize_size must be at least 16, got 8"),
        ({"record_videos": -1}, "record_videos must be at least 0, got -1"),
        ({"video_fps": 21}, "video_fps must be at most 20, got 21"),
    ],
)
def test_impossible_values_are_refused_where_they_are_set(tmp_path, arguments, message):
    origins = {f"eval.{name}": "exp.py:7" for name in arguments}
    context = RunContext(work_dir=tmp_path, section="eval", origins=origins)
    with pytest.raises(ConfigError) as caught:
        build_runner_from_cfg({"type": "LiberoEvalRunner", **arguments}, context)
    assert message in str(caught.value)
    assert str(caught.value).startswith("exp.py:7: eval.")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task_suite_name": "libero"}, "there is no suite 'libero'"),
        ({"render": "nice"}, "render 'nice' is unknown; choose one of cheap, coarse, reference"),
        ({"init_state": 50}, "init_state must be 0 to 49, got 50"),
        ({"record_fps": 3}, "record_fps must divide 20, got 3"),
        ({"task_descriptions": {"1": " "}}, "task '1' has no instruction"),
    ],
)
def test_an_inference_runner_refuses_impossible_values(arguments, message):
    with pytest.raises((ConfigError, UsageError), match=message):
        LiberoInferenceRunner(**arguments)


def test_the_specifications_parameters_and_how_to_compute_are_taken(tmp_path):
    table = {
        "type": "LiberoEvalRunner",
        "task_suite_name": "libero_10",
        "model_family": "pi0",
        "seed": 7,
        "ckpt_path": "somewhere",
        "dataset": {"type": "PrivateInferenceDataset"},
        "denormalize_action": {"type": "DenormalizePrivateAction"},
        "norm_stats_key": "libero_10_no_noops",
        "eval_chunk_size": 10,
        "resize_size": 224,
        "num_trials_per_task": 50,
        "num_steps_wait": 10,
        "mixed_precision_dtype": "bf16",
        "enable_mixed_precision_training": True,
        "execution": "compiled",
        "quantization": "int8",
    }
    runner = build_runner_from_cfg(table, RunContext(work_dir=tmp_path, nproc=3))
    assert runner.workers == 3
    assert runner.options.mixed_precision_dtype == "bf16"
    assert (runner.options.execution, runner.options.quantization) == ("compiled", "int8")
    assert runner.options.size == (224, 224)
    assert runner.options.policy_seed == 7
    assert runner.model_family == "pi0"


def test_running_before_setting_up_is_refused(tmp_path):
    runner = LiberoInferenceRunner(context=RunContext(work_dir=tmp_path), policy="expert")
    with pytest.raises(UsageError, match=r"call run_setup\(\) before run\(\)"):
        runner.run()


@pytest.mark.parametrize("kind", [LiberoEvalRunner, LiberoInferenceRunner])
def test_without_libero_it_is_said_what_to_install(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(require, "is_installed", lambda: False)
    from fluxvla_libero.suites import suite_tasks

    suite_tasks.cache_clear()
    with pytest.raises(MissingPlugin, match="LIBERO is not installed") as caught:
        kind(context=RunContext(work_dir=tmp_path), policy="expert").run_setup()
    assert "pip install 'fluxvla-libero[libero]'" in str(caught.value)
    assert caught.value.exit_code == 2


def test_a_libero_that_cannot_be_imported_is_named(monkeypatch):
    monkeypatch.setattr(require, "is_installed", lambda: True)
    monkeypatch.setitem(sys.modules, "libero.libero", None)
    monkeypatch.setitem(sys.modules, "mujoco", SimpleNamespace())
    with pytest.raises(RunFailed, match="LIBERO is installed and cannot be imported"):
        require.require_libero()


def test_a_libero_that_was_never_set_up_is_not_asked_in_the_dark(monkeypatch, tmp_path):
    """The classic LIBERO asks where its files are while it is imported."""
    package = tmp_path / "libero" / "libero"
    package.mkdir(parents=True)
    (tmp_path / "libero" / "__init__.py").touch()
    (package / "__init__.py").write_text("input('Do you want to specify a custom path?')")
    for name in [name for name in sys.modules if name.partition(".")[0] == "libero"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(require, "use_egl", lambda: None)
    stdin = sys.stdin
    with pytest.raises(RunFailed, match="LIBERO was never set up here") as caught:
        require.require_libero()
    assert "python -c 'import libero.libero', and answer" in str(caught.value)
    assert sys.stdin is stdin
    sys.modules.pop("libero")


def test_importing_runners_imports_no_simulator():
    code = (
        "import sys, fluxvla_libero.eval_runner, fluxvla_libero.inference_runner\n"
        "import fluxvla_libero.environment, fluxvla_libero.expert\n"
        "print([m for m in ('torch', 'mujoco', 'libero', 'robosuite') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr


def test_the_shipped_config_says_only_what_there_is():
    from fluxvla_core.config.check import check_config

    config = load_config(ROOT / "configs" / "libero_object.py")
    assert check_config(config).problems == ()


def test_the_experts_way_leads_from_above_the_object_into_the_container():
    low, high = np.array([0.1, 0.2, 0.0]), np.array([0.14, 0.26, 0.15])
    way = plan(low, high, np.array([-0.1, 0.2, 0.0]), np.array([0.1, 0.3, 0.1]))
    xy = [point.position[:2] for point in way]
    assert xy[:5] == [pytest.approx((0.12, 0.23))] * 5
    assert xy[5:] == [pytest.approx((0.0, 0.25))] * 4
    heights = [point.position[2] for point in way]
    assert heights[2] == pytest.approx(0.15 - 0.035), "the grasp"
    assert heights[4] - low[2] > 0.1 + heights[2], "carried above the rim"
    assert [point.gripper for point in way] == [-1, -1, -1, 1, 1, 1, 1, -1, -1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"suite": "libero"}, "there is no suite 'libero'"),
        ({"cameras": ("top",)}, "no camera 'top'; they have agentview, agentview_image, image"),
        ({"height": 8}, "images of 8x224 are too small"),
        ({"render": "nice"}, "render 'nice' is unknown; choose one of cheap, coarse, reference"),
        ({"begin": "anywhere"}, "begin 'anywhere' is unknown; choose one of fixed, random"),
        ({"num_steps_wait": -1}, "num_steps_wait must be at least 0, got -1"),
        ({"protocol": "openpi"}, "protocol 'openpi' is unknown; choose one of fluxvla, openvla"),
        ({"protocol": "openvla", "begin": "random"}, "it cannot begin at random"),
    ],
)
def test_impossible_environments_are_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        LiberoEnvironment(**arguments)


def test_an_expert_acts_in_libero_only_and_with_noise_up_to_one():
    with pytest.raises(ConfigError, match="noise must be from 0 to 1, got 2"):
        LiberoExpert(noise=2)
    expert = LiberoExpert()
    with pytest.raises(ConfigError, match="in LiberoEnvironment only, not in object"):
        expert.enter(object())
    with pytest.raises(ConfigError, match="does not know its environment"):
        expert.predict_action({})
