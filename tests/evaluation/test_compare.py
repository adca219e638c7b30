"""Two evaluations side by side: from folders to p-values, and what cannot be compared."""

from __future__ import annotations

import json
import os

import pytest

from fluxvla_core.cli.main import main
from fluxvla_core.errors import UsageError
from fluxvla_core.evaluation.compare import compare, describe, read
from fluxvla_core.evaluation.episodes import EvalLog


def evaluated(folder, outcomes, group="policy", name="episodes.jsonl", **about):
    what = {"policy": "checkpoint", "checkpoint": "abc", "settings": {"max_steps": 9}, **about}
    log = EvalLog(folder / "eval" / name, what)
    for (task, seed), success in outcomes.items():
        status = {"status": "done", "success": success} if success is not None else {
            "status": "error", "error": "it crashed",
        }  # fmt: skip
        log.add({"group": group, "task": task, "seed": seed, **status})
    return folder


def sides(tmp_path, a, b):
    return evaluated(tmp_path / "a", a), evaluated(tmp_path / "b", b)


A = {("lift", 0): True, ("lift", 1): True, ("lift", 2): True, ("push", 0): False}
B = {("lift", 0): False, ("lift", 1): True, ("lift", 2): False, ("push", 0): False}


def test_pairs_are_counted_over_all_and_by_task(tmp_path):
    a, b = sides(tmp_path, A, B)
    found = compare(read(a), read(b / "eval"))
    assert (found["all"]["only_a"], found["all"]["only_b"], found["all"]["pairs"]) == (2, 0, 4)
    assert found["all"]["p_different"] == 0.5
    assert found["tasks"]["push"]["neither"] == 1
    assert (found["all"]["a"]["successes"], found["all"]["b"]["successes"]) == (3, 1)
    assert found["differences"] == []


def test_one_task_is_not_said_to_be_all_of_them(tmp_path):
    several = describe(compare(*map(read, sides(tmp_path / "two", A, B))))
    assert [line.partition(":")[0] for line in several[2:5]] == ["lift", "push", "all 2 tasks"]
    one = [{k: v for k, v in side.items() if k[0] == "lift"} for side in (A, B)]
    lines = describe(compare(*map(read, sides(tmp_path / "one", *one))))
    assert lines[2].startswith("lift: A 3/3")
    assert "task" not in " ".join(lines[2:]).replace("all episodes", "")


def test_the_command_says_it_in_words_and_in_json(tmp_path, capsys):
    a, b = sides(tmp_path, A, B)
    assert main(["eval", "compare", str(a), str(b)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"A: {a / 'eval'} (policy)"
    assert lines[2].startswith("lift: A 3/3 (44% to 100%)  B 1/3 (6% to 79%)  A alone 2, B alone 0")
    assert lines[-1] == (
        "exact McNemar test, two-sided, all episodes: p = 0.5, nothing shown: 4 pairs cannot show "
        "any difference"
    )
    assert main(["eval", "compare", str(a), str(b), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["tasks"]["lift"]["only_a"] == 2


def test_episodes_that_are_not_the_same_end_in_exit_2_and_one_message(tmp_path, capsys):
    a, b = sides(tmp_path, A, {**B, ("push", 7): True})
    assert main(["eval", "compare", str(a), str(b)]) == 2
    error = capsys.readouterr().err
    assert "the two evaluations are not of the same episodes: only one has push/7" in error
    assert f"{a / 'eval'} has 4 finished episodes, {b / 'eval'} 5, 4 of them the same" in error
    assert "or compare what they share: --common" in error
    assert main(["eval", "compare", str(a), str(b), "--common"]) == 0
    assert "1 episodes that only one side has were left out" in capsys.readouterr().out


def test_nothing_in_common_cannot_be_compared_at_all(tmp_path):
    a, b = sides(tmp_path, {("lift", n): True for n in range(9)}, {("push", 0): True})
    for common in (False, True):
        with pytest.raises(UsageError, match=r"only one has lift/0, .*lift/4 and 5 more") as caught:
            compare(read(a), read(b), common)
        assert "--common" not in str(caught.value)


def test_groups_of_one_evaluation_can_be_compared(tmp_path, capsys):
    a = evaluated(tmp_path, A)
    evaluated(tmp_path, B, group="untrained")
    assert main(["eval", "compare", str(a), str(a), "--group-b", "untrained"]) == 0
    assert "A alone 2, B alone 0" in capsys.readouterr().out
    with pytest.raises(UsageError, match="no finished episode of group 'swapped'; there are polic"):
        read(a, "swapped")


def test_an_error_is_an_unpaired_episode(tmp_path):
    a, b = sides(tmp_path, A, {**B, ("lift", 1): None})
    with pytest.raises(UsageError, match="only one has lift/1"):
        compare(read(a), read(b))


def test_parts_of_a_job_are_one_evaluation(tmp_path):
    a = evaluated(tmp_path / "a", A)
    b = evaluated(
        tmp_path / "b", {("lift", 0): False, ("lift", 1): True}, name="episodes-0000-of-0002.jsonl"
    )
    evaluated(b, {("lift", 2): False, ("push", 0): False}, name="episodes-0001-of-0002.jsonl")
    found = compare(read(a), read(b))
    assert found["all"]["pairs"] == 4
    assert "A alone 2" in " ".join(describe(found))


def test_other_settings_are_said(tmp_path):
    a = evaluated(tmp_path / "a", A)
    b = evaluated(tmp_path / "b", B, settings={"max_steps": 12}, checkpoint="def")
    lines = describe(compare(read(a), read(b)))
    assert "not the same in both: settings.max_steps: 9 / 12" in lines
    assert not any("checkpoint" in line for line in lines)


def test_places_without_an_evaluation_are_refused(tmp_path):
    with pytest.raises(UsageError, match="there is no evaluation") as caught:
        read(tmp_path)
    assert "--section eval" in str(caught.value)


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")])
def test_a_log_without_an_end_is_refused_at_once(tmp_path, make):
    (tmp_path / "eval").mkdir()
    make(tmp_path / "eval" / "episodes.jsonl")
    with pytest.raises(UsageError, match=r"episodes\.jsonl: is not a regular file"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("line", "change"),
    [(1, {"task": None}), (1, {"seed": [1]}), (1, {"success": "yes"}), (1, {"group": 3})],
)
def test_a_line_that_is_no_episode_counts_as_none(tmp_path, line, change):
    a, b = sides(tmp_path, A, B)
    path = b / "eval" / "episodes.jsonl"
    lines = path.read_text().splitlines()
    lines[line] = json.dumps({**json.loads(lines[line]), **change})
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(UsageError, match="only one has lift/0"):
        compare(read(a), read(b))


@pytest.mark.parametrize("stated", [None, 3, [], "x"])
def test_a_log_that_does_not_say_of_what_it_is_is_no_evaluation(tmp_path, stated):
    path = evaluated(tmp_path, A) / "eval" / "episodes.jsonl"
    header, *rest = path.read_text().splitlines()
    header = json.dumps({**json.loads(header), "evaluation": stated})
    path.write_text("\n".join([header, *rest]) + "\n")
    with pytest.raises(UsageError, match="there is no evaluation"):
        read(tmp_path)


def test_a_checkpoint_stands_for_its_work_dir_if_it_was_the_one(tmp_path):
    from fluxvla_core.checkpoints.manifest import hash_file

    folder = tmp_path / "checkpoints" / "step-000000100"
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_text("{}")
    evaluated(tmp_path, A, checkpoint=hash_file(folder / "manifest.json"))
    assert len(read(folder).records) == 4
    (folder / "manifest.json").write_text("{ }")
    with pytest.raises(UsageError, match="is of another checkpoint"):
        read(folder)
