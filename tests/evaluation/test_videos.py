"""Which episodes are shown in videos, recording them again, and listing them."""

from __future__ import annotations

from pathlib import Path

from fluxvla_core.contracts.runner import SilentReporter
from fluxvla_core.evaluation.pool import WorkerPool
from fluxvla_core.evaluation.videos import (
    choose_episodes,
    record_videos,
    recorded_videos,
    video_name,
    with_others,
)


def record(task, seed, success, group="policy", **more):
    head = {"group": group, "task": task, "seed": seed, "status": "done", "success": success}
    return {**head, "steps": 10, "calls": 2, "timing": {"policy_seconds": 0.004}, **more}


def test_failures_come_first_and_tasks_in_turn():
    records = [record(t, s, s > 2) for s in range(6) for t in ("a", "b")]
    chosen = [(r["task"], r["seed"]) for r in choose_episodes(records, 4)]
    assert chosen == [("a", 0), ("b", 0), ("a", 3), ("b", 3)]
    assert len(choose_episodes(records, 100)) == 12
    assert choose_episodes(records, 0) == []


def test_what_there_is_fills_up_what_there_is_not():
    only = [record("a", s, True) for s in range(5)]
    assert [r["seed"] for r in choose_episodes(only, 3)] == [0, 1, 2]
    one = [record("a", 0, False), *only[1:]]
    assert [r["seed"] for r in choose_episodes(one, 4)] == [0, 1, 2, 3]


def test_other_groups_and_errors_are_not_shown():
    records = [record("a", 0, False, group="untrained"), record("a", 1, False, status="error")]
    assert choose_episodes(records, 3) == []
    assert len(choose_episodes(records, 3, group="untrained")) == 1


def test_a_videos_name_says_what_it_shows():
    assert video_name(3, record("lift", 7, False)) == "03-failure-lift-seed-7.mp4"
    assert video_name(0, record("lift", 7, True)) == "00-success-lift-seed-7.mp4"


class Filmed:
    """A worker that runs jobs (key, path): leaves a file, unless the seed says otherwise."""

    def __call__(self):
        return self.work

    def work(self, job):
        key, path = job
        if key.seed == 13:
            raise RuntimeError("the camera fell over")
        Path(path).write_bytes(b"mp4")
        return {"state_hash": "other" if key.seed == 7 else "same"}


def test_videos_are_of_the_episodes_that_were_counted(tmp_path):
    folder, said = tmp_path / "videos", []
    folder.mkdir()
    (folder / "00-old.mp4").touch()

    class Listener(SilentReporter):
        def warn(self, text):
            said.append(text.strip().splitlines()[-1])

    records = [
        {"group": "policy", "task": "t", "seed": s, "success": s > 9, "state_hash": "same"}
        for s in (3, 7, 13)
    ]
    with WorkerPool(Filmed(), 1) as pool:
        made = record_videos(pool, records, folder, lambda key, path: (key, path), Listener())
    assert made == [
        {
            "group": "policy",
            "task": "t",
            "seed": seed,
            "success": False,
            "path": f"videos/0{number}-failure-t-seed-{seed}.mp4",
        }
        for number, seed in enumerate((3, 7))
    ]
    assert sorted(p.name for p in folder.iterdir()) == [Path(v["path"]).name for v in made]
    assert said == [
        "01-failure-t-seed-7.mp4: the episode went another way than when it was counted; "
        "its outcome does not follow from its seed alone",
        "RuntimeError: the camera fell over",
    ]


def test_every_group_is_seen_beside_the_trained_policy():
    def record(group, task, seed, success):
        return {"group": group, "task": task, "seed": seed, "success": success, "status": "done"}

    records = [
        record("policy", "lift", 1, False), record("policy", "lift", 2, True),
        record("swapped", "lift", 7, False), record("swapped", "lift", 2, False),
        record("untrained", "lift", 1, False), record("untrained", "pour", 1, False),
    ]  # fmt: skip
    shown = with_others(records[:2], records)

    assert shown[:2] == records[:2]
    # Of the same seed where there is one.
    assert [(r["group"], r["seed"]) for r in shown[2:]] == [("swapped", 2), ("untrained", 1)]
    assert with_others([], records) == []


def test_videos_that_were_recorded_with_the_episodes_are_listed_relative_to_the_results(tmp_path):
    record = {"group": "policy", "task": "t", "seed": 3, "success": True, "instruction": "go"}
    for name in ("a.mp4", "b.mp4"):
        (tmp_path / "inference" / "001-t").mkdir(parents=True, exist_ok=True)
        (tmp_path / "inference" / "001-t" / name).touch()
    recordings = [(record, tmp_path / "inference" / "001-t"), (record, tmp_path / "none")]
    assert recorded_videos(recordings, tmp_path / "eval_robot") == [
        {**record, "path": "../inference/001-t/a.mp4"}
    ]
