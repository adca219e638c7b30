"""The demo's order, its memory and its words; the commands themselves are stood in for."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
from pathlib import Path

import pytest

from tools.demo import __main__ as program
from tools.demo import next_steps, outcome, stages
from tools.demo.journal import Entry, Journal, key_of
from tools.demo.run import Demo
from tools.demo.sizes import (
    AFTER_TRAINING_S,
    AROUND_STEPS_S,
    SIZES,
    Size,
    affordable_steps,
    expected_s,
    left_s,
)
from tools.shell import StepFailed

RATE = {"episodes": 50, "rate": 0.88, "successes": 44, "low": 0.76, "high": 0.94}
NONE = {"episodes": 50, "rate": 0.0, "successes": 0, "low": 0.0, "high": 0.07}


class Programs:
    """Stands in for the commands: writes what they would, and can fail at one of them."""

    def __init__(self, root: Path) -> None:
        self.work = root / "work"
        self.root = root
        self.ran: list[list[str]] = []
        self.fail_at: str | None = None
        self.error: BaseException = StepFailed(["fluxvla"], 1)
        self.step_s = 0.5

    def __call__(self, words: list[str]) -> None:
        self.ran.append(words)
        line = shlex.join(words)
        where = Path(words[words.index("--work-dir") + 1]) if "--work-dir" in words else self.work
        if self.fail_at is not None and self.fail_at in line:
            raise self.error
        if "collect" in words:
            (self.root / "dataset").mkdir(exist_ok=True)
            (self.root / "dataset" / "data").write_bytes(b"x" * 1_500_000)
        if "runner" in words:
            (where / "checkpoints" / "step-000000012").mkdir(parents=True, exist_ok=True)
            rows = [{"step": n, "step_time": 9.0 if n < 4 else self.step_s} for n in range(1, 11)]
            (where / "metrics.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows))
        if "eval" in words:
            (where / "eval").mkdir(exist_ok=True)
            groups = {"policy": {"all": RATE}, "untrained": {"all": NONE}}
            (where / "eval" / "results.json").write_text(json.dumps({"groups": groups}))
        if "report" in words:
            (self.root / "report.html").write_text("<html>")

    def kinds(self) -> list[str]:
        """The commands that ran, in short."""
        words = [
            line[line.index("--section") + 1] if "--section" in line else line[1]
            for line in self.ran
        ]
        self.ran = []
        return words


@pytest.fixture(autouse=True)
def _in_the_repository(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(Path(__file__).parents[2])


@pytest.fixture
def programs(tmp_path: Path) -> Programs:
    return Programs(tmp_path / "out")


@pytest.fixture
def said() -> list[str]:
    return []


def demo(programs: Programs, said: list[str], size: str = "smoke", build: str = "1") -> Demo:
    return Demo(SIZES[size], programs.root, build, 10.0, programs, said.append)


ALL = ["collect", "runner", "eval", "inference", "inference", "report"]


def test_every_stage_in_its_order(programs: Programs, said: list[str]) -> None:
    demo(programs, said).run()
    lines = [shlex.join(words) for words in programs.ran]
    assert programs.kinds() == ALL
    assert f"--out {programs.root}/dataset --episodes 8" in lines[0]
    assert "--config configs/aloha_sim_transfer.py --section runner" in lines[1]
    assert f"--set train_dataloader.dataset.data_root_path={programs.root}/dataset" in lines[1]
    assert "--set runner.max_steps=12" in lines[1]
    assert "--section eval" in lines[2]
    assert "--set eval.episodes=1" in lines[2]
    assert "--task 1" in lines[3]
    assert "--task 2" in lines[4]
    told = "\n".join(said)
    assert f"dataset      {programs.root}/dataset (1.5 MB)" in told
    assert f"checkpoint   {programs.work}/checkpoints/step-000000012" in told
    assert f"report       {programs.root}/report.html" in told
    assert "trained policy: 44 of 50 episodes succeed (88%, 95 % interval 76% to 94%)" in told
    assert "training made the difference" in told
    assert "in all (install 0:10, collect 0:00, train 0:00," in told
    assert said[-6].endswith("webbrowser " + (programs.root / "report.html").resolve().as_uri())
    work = f"--work-dir {programs.work}"
    for words, line in zip(
        (
            f"--section eval --work-dir {programs.root}/again --set eval.ckpt_path={programs.work}",
            f"--section inference {work} --task 'hand the cube over to the left arm'",
            f"--config configs/aloha_sim_ros2.py --section inference {work} --task 1",
            "at the same time: fluxvla sim aloha --ros2",
            f"--section runner {work}",
        ),
        said[-5:],
        strict=True,
    ):
        assert words in line
    assert "--set runner.max_steps=24" in said[-1]
    rows = json.loads((programs.work / "stages.json").read_text())["stages"]
    assert [r["name"] for r in rows] == [
        *("install", "collect", "train", "evaluate", "robot 1", "robot 2")
    ]
    assert rows[1]["command"].startswith("fluxvla collect aloha")


def test_what_it_names_is_what_its_config_and_the_page_of_ros2_name() -> None:
    """The instruction is one of the config's, the robot's command the one that docs/ros2.md has."""
    assert next_steps.OTHER_TASK in stages.CONFIG.read_text(encoding="utf-8")
    assert next_steps.ROBOT in Path("docs/ros2.md").read_text(encoding="utf-8")


def test_what_is_done_is_kept(programs: Programs, said: list[str]) -> None:
    demo(programs, said).run()
    programs.ran = []
    said.clear()
    demo(programs, said).run()
    assert programs.ran == []
    assert "stage 2 of 6: train for 12 steps" in "\n".join(said)
    assert "done before, in 0:00" in "\n".join(said)


@pytest.mark.parametrize("error", [StepFailed(["fluxvla"], 1), KeyboardInterrupt()])
def test_a_stage_that_stopped_goes_on(
    programs: Programs, said: list[str], error: BaseException
) -> None:
    programs.fail_at, programs.error = "--section runner", error
    with pytest.raises(type(error)):
        demo(programs, said).run()
    assert programs.kinds() == ["collect", "runner"]
    programs.fail_at = None
    demo(programs, said).run()
    assert programs.ran[0][-2:] == ["--resume", "auto"]
    assert programs.kinds() == ALL[1:]
    assert "train for 12 steps in 2 process(es): going on" in "\n".join(said)


def test_an_interrupted_collection_goes_on(programs: Programs, said: list[str]) -> None:
    programs.fail_at = "collect"
    with pytest.raises(StepFailed):
        demo(programs, said).run()
    programs.fail_at = None
    demo(programs, said).run()
    assert programs.ran[1][-1] == "--resume"


def test_other_code_or_another_stage_before_it_means_anew(
    programs: Programs, said: list[str]
) -> None:
    demo(programs, said).run()
    old = programs.work / "checkpoints" / "old"
    old.mkdir()
    programs.ran = []
    demo(programs, said, build="2").run()
    assert "--resume" not in programs.ran[1]
    assert programs.kinds() == ALL
    assert not old.exists()
    assert f"{programs.work} was made with other inputs: starting again" in "\n".join(said)


def test_a_demo_made_anew_has_the_whole_time_again(programs: Programs, said: list[str]) -> None:
    programs.step_s = 1.0
    demo(programs, said, "default").run()
    journal = Journal(programs.root / "journal.json")
    steps = journal.entries["measure"].result["steps"]
    for entry in journal.entries.values():
        entry.seconds += 200.0
    journal.save()
    demo(programs, said, "default", build="2").run()
    again = Journal(programs.root / "journal.json")
    assert again.entries["measure"].result["steps"] == steps
    assert again.entries["install"].seconds == 10.0


def test_a_damaged_journal_only_costs_time(programs: Programs, said: list[str]) -> None:
    demo(programs, said).run()
    for content in ("", "{", "[]", '{"collect": {"nonsense": 1}}'):
        (programs.root / "journal.json").write_text(content)
        programs.ran = []
        demo(programs, said).run()
        assert programs.kinds() == ALL


def test_the_journal_keeps_what_it_was_told(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "j.json")
    journal.entries["a"] = Entry("k", True, 1.5, "x y", {"steps": 3})
    journal.save()
    assert Journal(tmp_path / "j.json").entries == journal.entries
    assert key_of("a", ["b"]) == key_of("a", ("b",)) != key_of("a", ["c"])


def test_with_a_time_limit_the_speed_is_measured_first(programs: Programs, said: list[str]) -> None:
    demo(programs, said, "default").run()
    lines = [shlex.join(words) for words in programs.ran]
    assert "--set runner.max_steps=10" in lines[1]
    assert f"--work-dir {programs.root}/speed" in lines[1]
    fit = int((19 * 60 - 10 - AFTER_TRAINING_S - AROUND_STEPS_S) / 0.5)
    assert "a step takes 0.50 s: 1500 steps fit\n" in said
    assert fit > 1500
    assert "--set runner.max_steps=1500" in lines[2]
    assert any("at most 20 minutes" in line for line in said)


def test_steps_that_fit() -> None:
    size = SIZES["default"]
    spare = AFTER_TRAINING_S + AROUND_STEPS_S
    assert affordable_steps(size, 1.0, 0.0) == int(19 * 60 - spare)
    assert affordable_steps(size, 1.0, 100.0) == int(19 * 60 - spare - 100)
    assert affordable_steps(size, 1.0, 0.0, pace=1.5) == int(19 * 60 - 1.5 * spare)
    assert affordable_steps(size, 1.0, 0.0, pace=0.5) == affordable_steps(size, 1.0, 0.0)
    assert affordable_steps(size, 0.01, 0.0) == size.steps
    assert affordable_steps(size, 30.0, 0.0) == size.fewest_steps
    assert affordable_steps(SIZES["full"], 30.0, 1e6) == SIZES["full"].steps


def test_the_time_left_follows_how_fast_the_machine_is() -> None:
    expected = {"collect": 100.0, "train": 200.0, "report": 10.0}
    assert left_s(expected, {}) == 310.0
    assert left_s(expected, {"collect": 150.0}) == 1.5 * 210.0
    assert left_s(expected, {"collect": 50.0, "train": 100.0}) == 5.0
    assert left_s(expected, {"collect": 100.0, "train": 400.0, "report": 1.0}) == 0.0


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
def test_what_is_expected_are_the_stages_of_a_demo(
    programs: Programs, said: list[str], size: Size
) -> None:
    demo(programs, said, size.name).run()
    entries = Journal(programs.root / "journal.json").entries
    assert list(entries) == ["install", *expected_s(size)]
    heads = [line for line in said if line.startswith("stage ")]
    assert [head.partition(":")[0] for head in heads] == [
        f"stage {n + 1} of {len(heads)}" for n in range(len(heads))
    ]
    assert all(re.search(r" · \d+:\d\d so far, about [\d:]+ left$", head) for head in heads)
    if size.minutes is not None:
        assert sum(expected_s(size).values()) <= size.minutes * 60


def test_the_median_step_leaves_the_first_ones_out(tmp_path: Path) -> None:
    file = tmp_path / "m.jsonl"
    file.write_text("".join(f'{{"step_time": {t}}}\n' for t in (9, 9, 9, 1, 3, 2)))
    assert outcome.median_step_s(file) == 2.0
    with pytest.raises(ValueError, match="holds 6 steps, more than 6 are needed"):
        outcome.median_step_s(file, skip=6)


def test_the_verdict_says_when_nothing_was_shown(tmp_path: Path) -> None:
    file = tmp_path / "r.json"
    table = {"policy": {"all": {**NONE, "high": 0.3}}, "untrained": {"all": NONE}}
    file.write_text(json.dumps({"groups": table}))
    assert outcome.verdict(file)[-1] == (
        "the intervals overlap: this says nothing about the training"
    )
    swapped = {
        "groups": {"swapped": {"all": {**NONE, "successes": 1}}},
        "obeyed": {"swapped": RATE},
    }
    file.write_text(json.dumps(swapped))
    assert outcome.verdict(file) == [
        "wrong instruction: follows the instruction: 44 of 50 episodes "
        "(88%, 95 % interval 76% to 94%)"
    ]
    file.write_text(json.dumps({"groups": {"mine": {"all": RATE}, "no": {"all": {"episodes": 0}}}}))
    assert outcome.verdict(file) == [
        "mine: 44 of 50 episodes succeed (88%, 95 % interval 76% to 94%)"
    ]


@pytest.mark.parametrize(("seconds", "text"), [(5.4, "0:05"), (245, "4:05"), (3753, "1:02:33")])
def test_clock(seconds: float, text: str) -> None:
    assert outcome.clock(seconds) == text


def test_as_many_processes_as_are_of_use(monkeypatch: pytest.MonkeyPatch) -> None:
    for gpus, ranks in ((0, 2), (1, 1), (2, 2), (8, 2)):
        monkeypatch.setattr(stages, "nvidia_gpus", lambda found=gpus: found)
        assert stages.processes() == ranks
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(32)), raising=False)
    assert stages.cores() == 8
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0}, raising=False)
    assert stages.cores() == 1


class TestProgram:
    """The command line of the demo."""

    @pytest.fixture
    def out(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        def run(self: Demo) -> None:
            (self.places.root / "ran").touch()

        monkeypatch.setattr(Demo, "run", run)
        return tmp_path / "out"

    @pytest.mark.parametrize(
        ("words", "folder"), [([], "default"), (["--smoke"], "smoke"), (["--full"], "full")]
    )
    def test_forms(self, out: Path, words: list[str], folder: str) -> None:
        assert program.main([*words, "--out", str(out)]) == 0
        assert (out / folder / "ran").exists()

    def test_fresh_deletes_this_form_only(self, out: Path) -> None:
        for name in ("smoke", "full"):
            (out / name).mkdir(parents=True)
            (out / name / "old").touch()
        assert program.main(["--smoke", "--fresh", "--out", str(out)]) == 0
        assert not (out / "smoke" / "old").exists()
        assert (out / "full" / "old").exists()

    @pytest.mark.parametrize("words", [["--smoke", "--full"], ["--smok"], ["more"]])
    def test_slips_are_refused(
        self, out: Path, words: list[str], capsys: pytest.CaptureFixture[str]
    ) -> None:
        with pytest.raises(SystemExit) as end:
            program.main([*words, "--out", str(out)])
        assert end.value.code == 2
        assert "nox -s demo --" in capsys.readouterr().err

    @pytest.mark.parametrize(
        ("error", "code", "words"),
        [
            (StepFailed(["fluxvla", "run"], 2), 2, "Once the cause is removed, run the same"),
            (StepFailed(["fluxvla", "run"], -9), 1, "exit status -9 from: fluxvla run"),
            (KeyboardInterrupt(), 130, "interrupted. To go on, run the same command again"),
        ],
    )
    def test_endings(
        self,
        out: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
        error: BaseException,
        code: int,
        words: str,
    ) -> None:
        def run(self: Demo) -> None:
            raise error

        monkeypatch.setattr(Demo, "run", run)
        assert program.main(["--out", str(out)]) == code
        assert words in capsys.readouterr().err


def test_the_folder_can_be_deleted_while_nothing_runs(programs: Programs, said: list[str]) -> None:
    demo(programs, said).run()
    shutil.rmtree(programs.root)
    demo(programs, said).run()
    assert (programs.root / "report.html").exists()
