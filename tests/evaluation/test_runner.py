"""The evaluation runner: outcomes by seed for any number of workers, batches, parts, crashes."""

from __future__ import annotations

import json
import shutil
from collections import Counter

import pytest

from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.config.load import load_config
from fluxvla_core.errors import ConfigError, MissingPlugin, RunFailed, SpecMismatch, UsageError
from fluxvla_core.evaluation.collect import Collection, collect
from fluxvla_core.evaluation.compare import read
from fluxvla_core.evaluation.runner import EvalRunner
from fluxvla_core.plugins.registry import forget_plugin_files, load_plugin_files
from tests.evaluation.conftest import WALKING
from tests.evaluation.runs import WALK, evaluate


def courses(work_dir):
    """What outcomes consist of, by key: everything but how long it took."""
    found = {}
    for path in (work_dir / "eval").glob("episodes*.jsonl"):
        for record in map(json.loads, path.read_text().splitlines()[1:]):
            kept = {k: v for k, v in record.items() if k not in ("timing", "attempts")}
            found[record["group"], record["task"], record["seed"]] = kept
    return found


def results(work_dir):
    return json.loads((work_dir / "eval" / "results.json").read_text())


def test_outcomes_are_the_same_for_any_number_of_workers(tmp_path, walking):
    for workers in (1, 2, 4):
        result = evaluate(tmp_path / str(workers), workers=workers, instruction_swap=True)
    assert courses(tmp_path / "1") == courses(tmp_path / "2") == courses(tmp_path / "4")
    # Told to go left in the scene of right it goes the same way as in that of left.
    assert len({c["state_hash"] for c in courses(tmp_path / "1").values()}) == 8
    tasks = result["groups"]["policy"]["tasks"]
    assert {name: row["successes"] for name, row in tasks.items()} == {"right": 4, "left": 4}
    assert result["groups"]["swapped"]["all"]["successes"] == 0
    assert result["behaviours"]["swapped"]["go left"]["left"] == 4
    told = {group: (row["successes"], row["episodes"]) for group, row in result["obeyed"].items()}
    assert told == {"policy": (8, 8), "swapped": (8, 8)}
    assert result["instruction_test"]["p_a_better"] == 1 / 2**8
    assert result["settings"]["ground"] == "shaky"
    assert result["timing"]["worker_memory_mb"] > 1
    assert result["timing"]["step_ms"] > 0


def test_batches_workers_and_places_of_the_policy_change_nothing(tmp_path, checkpoint):
    def run(name, **options):
        folder = tmp_path / name
        evaluate(folder, policy="checkpoint", ckpt_path=str(checkpoint), batch_size=4, **options)
        return courses(folder)

    alone = run("own", workers=1, serve_policy=False)
    assert alone == run("served-1", workers=1)
    assert alone == run("served-2", workers=2)
    assert alone == run("served-4", workers=4)
    assert len({c["state_hash"] for c in alone.values()}) == 8


def test_the_untrained_twin_differs_from_the_policy(tmp_path, checkpoint):
    result = evaluate(
        tmp_path, policy="checkpoint", episodes=1, tasks=["left"], baseline=True, batch_size=2
    )
    found = courses(tmp_path)
    assert result["checkpoint"]["step"] == 100
    assert found["policy", "left", 0]["state_hash"] != found["untrained", "left", 0]["state_hash"]


def test_a_crashed_environment_is_tried_again_and_then_is_no_failure_of_the_policy(
    tmp_path, walking, listener
):
    marks = tmp_path / "marks"
    marks.mkdir()
    environment = {**WALK, "marks": str(marks), "crashing": 1, "shaky": 2}
    with pytest.raises(RunFailed, match="1 of 4 episodes gave no result, so the rates") as caught:
        evaluate(tmp_path, environment, tasks=["right"], reporter=listener)
    assert "the last one: its process died (exit code 9)" in str(caught.value)
    assert "run the same command again: only these are tried again" in str(caught.value)
    result = results(tmp_path)
    counted = result["groups"]["policy"]["tasks"]["right"]
    assert (counted["errors"], counted["episodes"], counted["successes"]) == (1, 3, 3)
    assert Counter(p.name.split(".")[0] for p in marks.iterdir()) == {
        "right-0": 2,
        "right-1": 2,
        "right-2": 1,
        "right-3": 1,
    }
    assert listener.warnings == [
        "episode policy/right/0 gave no result after 2 attempts: its process died (exit code 9)",
        "policy: 1 episode gave no result: its process died (exit code 9)",
    ]
    assert "right: 3/3 = 100%" in " ".join(listener.lines)


NAN = "the policy's chunk is not finite: action 0, x is nan"


@pytest.mark.parametrize(
    ("seeds", "successes", "failed"), [(None, 0, 10), ([1, 4, 7], 7, 3), ([0, 1], 8, 2)]
)
def test_chunks_that_are_not_finite_are_failures_of_the_policy(
    tmp_path, walking, listener, seeds, successes, failed
):
    policy = {"type": "Dazed", "seeds": seeds}
    options = {"policy": policy, "tasks": ["right"], "episodes": 10, "reporter": listener}
    for workers in (1, 2):
        found = evaluate(tmp_path / str(workers), workers=workers, **options)
    assert courses(tmp_path / "1") == courses(tmp_path / "2")
    counted = found["groups"]["policy"]["all"]
    assert (counted["episodes"], counted["errors"]) == (10, 0)
    assert (counted["successes"], counted["rate"]) == (successes, successes / 10)
    assert found["problems"] == [
        {"group": "policy", "status": "done", "what": NAN, "episodes": failed}
    ]
    assert {c["problem"] for c in courses(tmp_path / "1").values() if not c["success"]} == {NAN}
    assert listener.warnings == [f"policy: {failed} episodes failed: {NAN}"] * 2


def test_what_a_policy_raises_is_told_and_the_evaluation_is_not_whole(tmp_path, walking, listener):
    """It may as well be the set-up that is wrong: nothing to be counted quietly as 0 %."""
    policy = {"type": "Dazed", "seeds": [2], "raises": True}
    with pytest.raises(RunFailed, match=r"1 of 4 episodes gave no result.*: KeyError: 'compass'"):
        evaluate(tmp_path, policy=policy, tasks=["right"], reporter=listener)
    assert listener.warnings[-1] == "policy: 1 episode gave no result: KeyError: 'compass'"
    found = results(tmp_path)
    assert found["groups"]["policy"]["all"]["episodes"] == 3
    assert found["problems"] == [
        {"group": "policy", "status": "error", "what": "KeyError: 'compass'", "episodes": 1}
    ]


def test_a_policy_of_another_shape_is_refused_at_once(tmp_path, walking):
    marks = tmp_path / "marks"
    marks.mkdir()
    with pytest.raises(SpecMismatch, match=r"the policy's chunk has shape \(3, 2\)"):
        evaluate(tmp_path, {**WALK, "marks": str(marks)}, policy="TwoLegs", workers=1)
    assert len(list(marks.iterdir())) == 1


@pytest.mark.parametrize("serve_policy", [False, True])
def test_a_simulation_that_diverges_is_an_error_of_its_episode(
    tmp_path, checkpoint, listener, serve_policy
):
    options = {"policy": "checkpoint", "ckpt_path": str(checkpoint), "serve_policy": serve_policy}
    options |= {"tasks": ["right"], "workers": 1, "max_steps": 8}
    with pytest.raises(RunFailed, match="1 of 4 episodes gave no result"):
        evaluate(tmp_path, {**WALK, "diverging": 1}, reporter=listener, **options)
    assert listener.warnings[-1] == (
        "policy: 1 episode gave no result: the environment's state is not finite after 3 steps"
    )
    assert results(tmp_path)["groups"]["policy"]["all"]["episodes"] == 3


def test_errors_of_other_parts_are_no_failure_of_one_that_had_nothing_to_do(
    tmp_path, walking, monkeypatch
):
    """It would end the part that is about to try them again: torchrun ends all with one."""
    environment = {**WALK, "diverging": 1}
    options = {"tasks": ["right"], "episodes": 2, "workers": 1}
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "0")
    assert evaluate(tmp_path, environment, **options)["episodes_left"] == 1
    monkeypatch.setenv("RANK", "1")
    with pytest.raises(RunFailed, match="1 of 2 episodes gave no result"):
        evaluate(tmp_path, environment, **options)
    assert evaluate(tmp_path, environment, **options)["groups"]["policy"]["all"]["errors"] == 1


def test_finished_episodes_are_never_run_again(tmp_path, walking, listener):
    marks = tmp_path / "marks"
    marks.mkdir()
    environment = {**WALK, "marks": str(marks)}
    evaluate(tmp_path, environment, tasks=["right"])
    before = {p.name for p in marks.iterdir()}
    evaluate(tmp_path, environment, tasks=["right"], episodes=6, reporter=listener)
    new = {p.name.split(".")[0] for p in marks.iterdir() if p.name not in before}
    assert new == {"right-4", "right-5"}
    assert "4 of 6 episodes are there already; running the others" in listener.lines


def test_parts_of_a_job_are_run_apart_and_merged(tmp_path, walking, monkeypatch, listener):
    evaluate(tmp_path / "whole")
    for rank in ("0", "1", "2"):
        monkeypatch.setenv("RANK", rank)
        monkeypatch.setenv("WORLD_SIZE", "3")
        result = evaluate(tmp_path / "parts", reporter=listener)
        if rank != "2":
            assert result["shard"] == int(rank)
            assert not (tmp_path / "parts" / "eval" / "results.json").exists()
    assert "part 0 of 3 is done; 5 episodes of other parts are not: the process" in " ".join(
        listener.lines
    )
    assert courses(tmp_path / "parts") == courses(tmp_path / "whole")
    assert (
        result["groups"]
        == json.loads((tmp_path / "whole" / "eval" / "results.json").read_text())["groups"]
    )
    # Another number of parts finds everything done.
    monkeypatch.setenv("WORLD_SIZE", "4")
    assert evaluate(tmp_path / "parts")["groups"] == result["groups"]


def test_a_gpu_of_ones_own_makes_no_part_another_evaluation(tmp_path, checkpoint, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "8")
    devices = set()
    for rank in ("0", "5"):
        monkeypatch.setenv("RANK", rank)
        monkeypatch.setenv("LOCAL_RANK", rank)
        runner = EvalRunner(
            context=RunContext(work_dir=checkpoint), environment=WALK, device="cuda"
        )
        runner.run_setup()
        devices.add(runner.identity()["settings"]["device"])
    assert devices == {"cuda"}


def test_nproc_is_workers_but_for_torchruns_own_count(tmp_path, walking, monkeypatch):
    def workers(**variables):
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        context = RunContext(work_dir=tmp_path, nproc=5)
        return EvalRunner(context=context, environment=WALK, workers=3).workers

    assert workers() == 5
    assert workers(SLURM_ARRAY_TASK_ID="0", SLURM_ARRAY_TASK_COUNT="2") == 5
    one = RunContext(work_dir=tmp_path, nproc=1)
    assert EvalRunner(context=one, environment=WALK, workers=3).workers == 1
    assert workers(RANK="1", WORLD_SIZE="5") == 3
    context = RunContext(work_dir=tmp_path)
    assert EvalRunner(context=context, environment=WALK, live=True).workers == 1


def test_videos_show_failures_first(tmp_path, walking):
    pytest.importorskip("av")
    result = evaluate(
        tmp_path, policy={"type": "Walker", "speed": 0.05}, max_steps=25, record_videos=3
    )
    assert [video["success"] for video in result["videos"]] == sorted(
        video["success"] for video in result["videos"]
    )
    assert len(result["videos"]) == 3
    assert all((tmp_path / "eval" / video["path"]).stat().st_size for video in result["videos"])


def test_other_settings_are_another_evaluation(tmp_path, walking, listener):
    evaluate(tmp_path, tasks=["right"])
    evaluate(tmp_path, tasks=["right"], replan_every=1, reporter=listener)
    assert "episodes.jsonl was about another evaluation; it is" in listener.lines[0]
    first = (tmp_path / "eval" / "episodes.jsonl").read_text()
    evaluate(tmp_path, tasks=["right"], workers=1, episodes=3, replan_every=1)
    assert (tmp_path / "eval" / "episodes.jsonl").read_text() == first, "nothing was missing"


def test_episodes_of_other_code_are_asked_for_and_never_silently_counted(
    tmp_path, walking, listener, monkeypatch
):
    options = {"tasks": ["right"], "episodes": 2, "workers": 1}
    evaluate(tmp_path, **options)
    first = results(tmp_path)["provenance"]
    assert set(first) >= {"date", "commit", "versions", "code", "machine", "seeds", "images"}
    assert first["seeds"] == {"policy": [0, 1]}
    assert first["reused"] == {"episodes": 0, "changed": []}
    assert {"fluxvla-core", "numpy"} <= set(first["versions"])
    assert first["date"].endswith("+00:00")
    before = (tmp_path / "eval" / "results.json").read_text()

    path = tmp_path / "walking.py"  # the plugin file, edited; its name is the same
    path.write_text(WALKING.read_text() + "\n# faster\n")
    forget_plugin_files()
    load_plugin_files([path])
    with pytest.raises(UsageError, match=r"run with other code: source code \w+ -> \w+") as caught:
        evaluate(tmp_path, **options, reporter=listener)
    assert "--set <section>.reuse=true to count them" in str(caught.value)
    assert (tmp_path / "eval" / "results.json").read_text() == before

    evaluate(tmp_path, **{**options, "episodes": 3}, reuse=True, reporter=listener)
    assert listener.warnings[0].startswith("2 episodes that other code ran are counted, as reuse")
    second = results(tmp_path)["provenance"]
    assert second["code"] != first["code"]
    assert second["reused"]["episodes"] == 2
    assert results(tmp_path)["groups"]["policy"]["all"]["episodes"] == 3
    # The third is of this code; the other two are not, however often they were counted.
    with pytest.raises(UsageError, match="run with other code"):
        evaluate(tmp_path, **options)
    compared = read(tmp_path)
    assert len(compared.records) == 3


def test_each_evaluation_keeps_its_own_config(tmp_path, walking):
    environment = {"type": "Walk", "limited": True}
    for live in (False, True):
        section = {"type": "EvalRunner", "environment": environment, "live": live}
        section |= {"policy": "expert", "episodes": 1, "record_videos": 0, "tasks": ["right"]}
        context = RunContext({"eval": section}, "eval", tmp_path, origins={"eval": "c.toml:1"})
        runner = build_runner_from_cfg(section, context)
        runner.run_setup()
        runner.run()
    for name, live in (("eval", False), ("eval_live", True)):
        kept = load_config(tmp_path / name / "config.resolved.json")
        assert kept.tree["eval"]["live"] is live


@pytest.mark.parametrize(("first", "unseen"), [(50, True), (41, False)])
def test_results_say_whether_training_saw_their_seeds(tmp_path, checkpoint, first, unseen):
    options = {"policy": "checkpoint", "ckpt_path": str(checkpoint), "tasks": ["right"]}
    options |= {"episodes": 2, "workers": 1, "seed": first, "max_steps": 4}
    evaluate(tmp_path / "unknown", **options)
    assert results(tmp_path / "unknown")["provenance"]["unseen_seeds"] is None
    collect(tmp_path / "demonstrations", Collection(WALK, 2, seed=40), workers=1)
    evaluate(tmp_path, **options)
    assert results(tmp_path)["provenance"]["unseen_seeds"] is unseen


def test_how_images_were_drawn_is_in_the_results(tmp_path, walking):
    evaluate(tmp_path, policy={"type": "Thinker"}, tasks=["right"], episodes=1, workers=1)
    images = results(tmp_path)["provenance"]["images"]
    assert images == {"sizes": {"eye": [24, 32]}, "by": []}, "no OpenGL drew these"


def test_chance_does_what_chance_does(tmp_path, walking):
    result = evaluate(tmp_path, policy="random", tasks=["right"])
    assert result["policy"] == "RandomPolicy"
    assert (
        evaluate(tmp_path / "again", policy="random", tasks=["right"], workers=1)["groups"]
        == result["groups"]
    )


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"environment": None}, "EvalRunner has no environment: where is the policy to act?"),
        ({"episodes": 0}, "episodes must be at least 1, got 0"),
        ({"batch_size": 0}, "batch_size must be at least 1, got 0"),
        ({"height": 3}, "height and width belong together: give both or none"),
        ({"video_fps": 0.0}, "video_fps must be positive, got 0"),
        ({"tasks": ["up"]}, "there is no task 'up'; there are right, left"),
        ({"tasks": ["left", "left"]}, r"tasks must name each task once, got \['left', 'left'\]"),
        ({"video_cameras": ["ear"]}, "video_cameras 'ear' is unknown; choose one of eye"),
    ],
)
def test_impossible_values_are_refused(tmp_path, walking, options, text):
    with pytest.raises(ConfigError, match=text):
        evaluate(tmp_path, **{"environment": WALK, **options})


def test_an_unknown_policy_or_environment_is_refused(tmp_path, walking):
    with pytest.raises(MissingPlugin, match="Wolk"):
        evaluate(tmp_path, {"type": "Wolk"})
    with pytest.raises(MissingPlugin, match="Wolker"):
        evaluate(tmp_path, policy="Wolker")


def test_a_policy_for_other_numbers_is_refused_before_the_first_step(tmp_path, checkpoint):
    marks = tmp_path / "marks"
    marks.mkdir()
    with pytest.raises(SpecMismatch, match="action mode: delta / absolute"):
        evaluate(
            tmp_path,
            {**WALK, "limited": True, "marks": str(marks)},
            policy="checkpoint",
            workers=1,
        )
    assert not list(marks.iterdir())


def test_statistics_that_the_checkpoint_lacks_are_refused(tmp_path, checkpoint):
    with pytest.raises(SpecMismatch, match="has no statistics 'other'; it has private"):
        evaluate(tmp_path, policy="checkpoint", norm_stats_key="other", serve_policy=True)
    shutil.rmtree(tmp_path / "eval")
    options = {"policy": "checkpoint", "tasks": ["left"], "episodes": 1, "serve_policy": True}
    evaluate(tmp_path, norm_stats_key="private", **options)
    with_key = courses(tmp_path)
    evaluate(tmp_path / "plain", ckpt_path=str(tmp_path), **options)
    assert with_key == courses(tmp_path / "plain")


def test_an_evaluation_without_any_result_is_none(tmp_path, walking):
    marks = tmp_path / "marks"
    marks.mkdir()
    with pytest.raises(RunFailed, match="none of the 1 episodes gave a result"):
        evaluate(
            tmp_path,
            {**WALK, "marks": str(marks), "crashing": 9},
            tasks=["right"],
            episodes=1,
        )
