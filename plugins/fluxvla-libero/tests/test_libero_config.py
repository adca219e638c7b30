"""What a config may say, and what is said where it says something impossible. Needs no LIBERO."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fluxvla_libero import require
from fluxvla_libero.collect import SPARE_STRIDE, Collection
from fluxvla_libero.eval_runner import LiberoEvalRunner, count_behaviours, instruction_test
from fluxvla_libero.eval_worker import wrong_task
from fluxvla_libero.expert import plan
from fluxvla_libero.inference_runner import LiberoInferenceRunner
from fluxvla_libero.rollout import _checked
from fluxvla_libero.suites import SUITES, SuiteTask, max_steps

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.config.load import load_config
from fluxvla_core.errors import ConfigError, MissingPlugin, RunFailed, UsageError

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
    assert LiberoEvalRunner(task_suite_name=suite)._settings.max_steps == steps


def test_an_unknown_suite_is_answered_with_those_there_are():
    with pytest.raises(ConfigError, match="there is no suite 'libero_objects'") as caught:
        max_steps("libero_objects")
    assert "libero_spatial, libero_object, libero_goal, libero_10" in str(caught.value)
    assert len(SUITES) == 5 + 16


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task_suite_name": "libero"}, "task_suite_name: there is no suite 'libero'"),
        ({"policy": "random"}, "policy: 'random' is none of checkpoint, expert, untrained"),
        ({"render": "nice"}, "render: 'nice' is none of cheap, coarse, reference"),
        ({"num_trials_per_task": 51}, "num_trials_per_task: must be 1 to 50, got 51"),
        ({"num_trials_per_task": 0}, "num_trials_per_task: must be 1 to 50, got 0"),
        ({"eval_chunk_size": 0}, "eval_chunk_size: must be at least 1, got 0"),
        ({"num_steps_wait": -1}, "num_steps_wait: must be at least 0, got -1"),
        ({"max_steps": -5}, "max_steps: must be at least 1, got -5"),
        ({"workers": 0}, "workers: must be at least 1, got 0"),
        ({"seed": -1}, "seed: must be at least 0, got -1"),
        ({"resize_size": 8}, "resize_size: must be at least 16, got 8"),
        ({"record_videos": -1}, "record_videos: must be at least 0, got -1"),
        ({"video_fps": 7}, "video_fps: must divide 20, got 7"),
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
        ({"policy": "random"}, "policy 'random' is none of"),
        ({"render": "nice"}, "render 'nice' is none of cheap, coarse, reference"),
        ({"init_state": 50}, "init_state must be 0 to 49, got 50"),
        ({"record_fps": 3}, "record_fps must divide 20, got 3"),
        ({"task_descriptions": {"1": " "}}, "task '1' has no instruction"),
    ],
)
def test_an_inference_runner_refuses_impossible_values(arguments, message):
    with pytest.raises((ConfigError, UsageError), match=message):
        LiberoInferenceRunner(**arguments)


def test_the_specifications_parameters_are_taken(tmp_path):
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
    }
    runner = build_runner_from_cfg(table, RunContext(work_dir=tmp_path, nproc=3))
    assert runner.workers == 3
    assert runner._settings.loading.precision == "bf16"
    assert runner._settings.size == (224, 224)
    assert runner._what()["settings"]["model_family"] == "pi0"


def test_what_the_outcomes_follow_from_does_not_hold_what_they_do_not(tmp_path):
    def what(**arguments):
        return LiberoEvalRunner(context=RunContext(work_dir=tmp_path), **arguments)._what()

    assert what(workers=1, record_videos=0, num_trials_per_task=3) == what(workers=2)
    for other in ({"render": "reference"}, {"eval_chunk_size": 3}, {"seed": 8}, {"max_steps": 9}):
        assert what(**other) != what()


def test_running_before_setting_up_is_refused(tmp_path):
    runner = LiberoEvalRunner(context=RunContext(work_dir=tmp_path), policy="expert")
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


def test_importing_runners_imports_no_simulator():
    code = (
        "import sys, fluxvla_libero.eval_runner, fluxvla_libero.inference_runner\n"
        "import fluxvla_libero.collect_command\n"
        "print([m for m in ('torch', 'mujoco', 'libero', 'robosuite') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr


def test_the_shipped_config_says_only_what_there_is():
    from fluxvla_core.config.check import check_config

    config = load_config(ROOT / "configs" / "libero_object.py")
    assert check_config(config).problems == ()


def task(index, suite="libero_object"):
    return SuiteTask(suite, index, f"task_{index}", f"do {index}", Path(f"{index}.bddl"))


def test_the_wrong_instruction_is_the_next_task_that_could_be_done():
    judged = tuple(task(i) for i in range(5))
    names = ("task_0", "task_2", "task_4")
    asked = [wrong_task(task(i), names, judged).index for i in (0, 2, 4)]
    assert asked == [2, 4, 0]
    assert wrong_task(task(0), ("task_0",), judged).index == 1, "else any of the suite"


def test_a_scene_with_one_task_has_no_wrong_instruction():
    same_words = SuiteTask("libero_object", 3, "other_name", "do 0", Path("x.bddl"))
    with pytest.raises(ConfigError, match="no other task of libero_object can be done"):
        wrong_task(task(0), ("task_0",), (task(0), same_words))


def record(group, seed, success, said="do it", **behaviours):
    return {
        "group": group,
        "task": "a",
        "seed": seed,
        "status": "done",
        "success": success,
        "instruction": said,
        "behaviours": behaviours,
    }


def test_the_instruction_test_pairs_right_and_wrong_words():
    records = [record("policy", s, True) for s in range(6)]
    assert instruction_test(records) is None
    records += [record("swapped", s, s == 0) for s in range(6)]
    found = instruction_test(records)
    assert (found["pairs"], found["only_a"], found["only_b"]) == (6, 5, 0)
    assert found["p_a_better"] == pytest.approx(1 / 32)


def test_behaviours_are_counted_by_what_was_said():
    records = [
        record("swapped", 0, False, "x", a=False, b=True),
        record("swapped", 1, False, "x", a=False, b=False),
        record("swapped", 2, True, "y", a=True, b=True),
        {"status": "error"},
    ]
    counted = count_behaviours(records)["swapped"]
    assert counted["x"] == {"episodes": 2, "neither": 1, "b": 1}
    assert counted["y"] == {"episodes": 1, "neither": 0, "a": 1, "b": 1}


@pytest.mark.parametrize(
    ("chunk", "message"),
    [
        (np.zeros((3, 6)), r"shape \(3, 6\); \(T, 7\) is needed"),
        (np.zeros(7), r"shape \(7,\)"),
        (np.zeros((0, 7)), r"shape \(0, 7\)"),
        (np.full((2, 7), np.nan), "not finite"),
    ],
)
def test_impossible_chunks_end_the_episode(chunk, message):
    with pytest.raises(RunFailed, match=message):
        _checked(chunk)


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
        ({"episodes": 0}, "episodes must be at least 1, got 0"),
        ({"camera_names": ("top",)}, "cameras must be of agentview, robot0_eye_in_hand"),
        ({"camera_names": ()}, "cameras must be of"),
        ({"height": 8}, "pictures of 8x224 are too small"),
        ({"noise": 2.0}, "noise must be from 0 to 1, got 2"),
        ({"render": "nice"}, "render 'nice' is none of cheap, coarse, reference"),
        ({"seed": SPARE_STRIDE}, "seed must be from 0 to"),
    ],
)
def test_impossible_collections_are_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        Collection(**{"episodes": 3, **arguments})
