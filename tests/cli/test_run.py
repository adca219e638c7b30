"""``fluxvla run`` in this process: sections, work dirs, records, refusals, endings."""

from __future__ import annotations

import json
import os
import signal
import threading
from pathlib import Path

import pytest

from fluxvla_core import RUNNERS, atomic
from fluxvla_core.cli.plan import default_work_dir
from fluxvla_core.cli.reporters import KeepAliveReporter
from fluxvla_core.config.load import load_config
from fluxvla_core.config.overrides import apply_overrides
from fluxvla_core.config.snapshot import write_resolved
from tests.conftest import Install

from .conftest import CONFIG, TOY, Fluxvla, Write


def said(folder: str = "work_dirs/c", rank: int = 0) -> dict[str, object]:
    found: dict[str, object] = json.loads((Path(folder) / f"said-{rank}.json").read_text())
    return found


def test_training(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "runner", "--set", "runner.max_epochs=2")
    assert (ended.code, ended.err) == (0, "")
    told = said()
    config = told.pop("config")
    assert told == {
        "section": "runner",
        "examples": 3,
        "resume": None,
        "nproc": 1,
        "file": "c.py",
        "epochs": 2,
        "threads": os.environ.get("OMP_NUM_THREADS"),
        "world": None,
        "where": "--set runner.max_epochs=2: runner.max_epochs",
    }
    saved = json.loads(Path("work_dirs/c/config.resolved.json").read_text())
    assert saved["config"] == config
    assert saved["origins"]["runner.max_epochs"] == "--set runner.max_epochs=2"
    environment = json.loads(Path("work_dirs/c/environment.json").read_text())
    assert environment["fluxvla-core"]
    texts = [line.partition("] ")[2] for line in ended.out.splitlines()]
    assert texts == [
        "train 1/2  loss 0.5",
        "train 2/2  loss 0.25",
        "loss: 0.25",
        "steps: 2",
        "work dir: work_dirs/c",
    ]


def test_a_hint_names_the_tables_of_the_config(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "runner", "--set", "runner.mode=hints")
    assert ended.code == 2
    assert (
        "next: --set runner.mode=a, --set train_dataloader.dataset.size=2 or --set <Gone>.size=2"
        in ended.err
    )


def test_a_section_that_is_silent_is_said_to_be_working(
    run: Fluxvla, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(KeepAliveReporter.__init__, "__defaults__", (0.1, "start"))
    ended = run("--config", "c.py", "--section", "runner", "--set", "runner.mode=silent")
    assert ended.code == 0
    assert "s since: train 1/2" in ended.out


def test_what_records_a_robots_run_is_part_of_the_config(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "runner", "--record", "rec")
    assert ended.code == 2
    assert "--record: runner.record: ToyTrainRunner takes no 'record'" in ended.err
    ended = run("--config", "c.py", "--section", "eval", "--record", "rec")
    assert "ToyEvalRunner takes no 'record'" in ended.err
    assert not Path("work_dirs").exists()


def test_the_resolved_config_of_a_run_runs_again(run: Fluxvla) -> None:
    run("--config", "c.py", "--section", "runner", "--set", "runner.max_epochs=2")
    first = said()
    ended = run(
        "--config",
        "work_dirs/c/config.resolved.json",
        "--section",
        "runner",
        "--work-dir",
        "again",
    )
    assert ended.code == 0, ended.err
    again = said("again")
    assert again["config"] == first["config"]
    assert again["where"] == first["where"]


def test_evaluation(run: Fluxvla) -> None:
    ended = run(
        "--config",
        "c.py",
        "--section",
        "eval",
        "--task",
        "lift it",
        "--nproc",
        "3",
        "--work-dir",
        "out/x",
    )
    assert ended.code == 0, ended.err
    assert Path("out/x/eval.txt").read_text() == "True lift it 3"
    assert Path("out/x/config.resolved.json").exists()


def test_what_is_evaluated_later_leaves_the_trainings_records_alone(run: Fluxvla) -> None:
    run("--config", "c.py", "--section", "runner")
    before = Path("work_dirs/c/config.resolved.json").read_text()
    run("--config", "c.py", "--section", "eval", "--set", "eval.seeds+=9")
    assert Path("work_dirs/c/config.resolved.json").read_text() == before
    theirs = json.loads(Path("work_dirs/c/eval/config.resolved.json").read_text())
    assert theirs["config"]["eval"]["seeds"] == 9
    assert Path("work_dirs/c/eval/environment.json").exists()


def test_the_resolved_config_of_what_was_evaluated_later_runs_in_the_same_work_dir(
    run: Fluxvla,
) -> None:
    run("--config", "c.py", "--section", "runner")
    run("--config", "c.py", "--section", "eval")
    evaluated = Path("work_dirs/c/eval.txt")
    evaluated.unlink()
    resolved = Path("work_dirs/c/eval/config.resolved.json")
    before = resolved.read_text()
    ended = run("--config", str(resolved), "--section", "eval")
    assert ended.code == 0, ended.err
    assert evaluated.exists()
    assert resolved.read_text() == before
    assert sorted(path.name for path in resolved.parent.iterdir()) == [
        "config.resolved.json",
        "environment.json",
    ]


def test_json_lines(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "runner", "--log-format", "json")
    records = [json.loads(line) for line in ended.out.splitlines()]
    assert [r["kind"] for r in records] == [
        "start",
        "progress",
        "progress",
        "info",
        "info",
        "result",
        "artifact",
    ]
    assert all(isinstance(r.pop("time"), float) for r in records)
    assert records[0] == {"kind": "start", "section": "runner", "work_dir": "work_dirs/c"}
    assert records[2] == {"kind": "progress", "name": "train", "done": 2, "total": 2, "loss": 0.25}
    assert records[5]["result"] == {"loss": 0.25, "steps": 2, "curve": [0.5, 0.25]}


def test_json_lines_of_a_failure(run: Fluxvla) -> None:
    ended = run(
        "--config",
        "c.py",
        "--section",
        "runner",
        "--log-format",
        "json",
        "--set",
        "runner.mode+=denied",
    )
    last = json.loads(ended.out.splitlines()[-1])
    assert (last["kind"], last["type"]) == ("error", "DataError")
    assert last["text"] == "a.mp4: bad data\n  next: look at it"


# -- which section ---------------------------------------------------------------------------


def test_one_section_is_the_default(run: Fluxvla, write: Write) -> None:
    write("d.py", "eval = dict(type='ToyEvalRunner')\nnote = dict(a=1)\n")
    assert run("--config", "d.py").code == 0
    assert Path("work_dirs/d/eval.txt").exists()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (
            (),
            "c.py: several sections can be run: runner (ToyTrainRunner), eval (ToyEvalRunner)\n"
            "  next: name one: --section runner",
        ),
        (
            ("--section", "evl"),
            "c.py: no section 'evl'; did you mean 'eval'?\n"
            "  next: sections there: runner (ToyTrainRunner), eval (ToyEvalRunner)",
        ),
        (("--section", "zzz"), "c.py: no section 'zzz'\n"),
        (
            ("--section", "train_dataloader"),
            "c.py: section 'train_dataloader' cannot be run: it is not a table whose type is a "
            "runner",
        ),
    ],
)
def test_sections_that_cannot_be_chosen(run: Fluxvla, words: tuple[str, ...], text: str) -> None:
    ended = run("--config", "c.py", *words)
    assert ended.code == 2
    assert text in ended.err
    assert not Path("work_dirs").exists()


def test_nothing_to_run(run: Fluxvla, write: Write) -> None:
    write("d.py", "x = 1\n")
    ended = run("--config", "d.py")
    assert ended.code == 2
    assert "d.py: nothing to run: no table at the top has a type that is a runner" in ended.err
    ended = run("--config", "d.py", "--section", "runner")
    assert "no section 'runner'\n  next: sections there: none" in ended.err
    write("e.py", "rehearse = dict(type='ToyEvalRuner')\n")
    ended = run("--config", "e.py")
    assert "rehearse.type: no plugin named 'ToyEvalRuner' in any registry" in ended.err


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (
            "DeepSpeedTrainRunner",
            "no plugin named 'DeepSpeedTrainRunner'; fluxvla-deepspeed provides it and is not "
            "installed: pip install fluxvla-deepspeed",
        ),
        ("ToyTrainRuner", "no plugin named 'ToyTrainRuner' in any registry; did you mean 'ToyTrai"),
    ],
)
def test_a_section_whose_runner_is_not_there(
    run: Fluxvla,
    write: Write,
    install: Install,
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
    text: str,
) -> None:
    monkeypatch.setenv("FLUXVLA_PLUGINS", "toy")
    install("fluxvla-toy")
    config = Path("c.py").read_text().replace("'ToyEvalRunner'", "'FarEvalRunner'")
    write("d.py", config + f"finetune = dict(type='{kind}')\n")
    ended = run("--config", "d.py", "--section", "finetune")
    assert ended.code == 2
    assert ended.err.startswith(f"1 problem in the config:\n  d.py:5: finetune.type: {text}")
    assert ended.err.endswith("next: fluxvla plugins list\n")


# -- bad input -------------------------------------------------------------------------------


def test_no_config(run: Fluxvla, write: Write) -> None:
    ended = run()
    assert ended.code == 2
    assert ended.err == ("no config given: fluxvla run --config FILE\n  next: fluxvla run --help\n")
    write("configs/a.py", "")
    write("configs/b.md", "")
    assert run().err.endswith("next: configs here: configs/a.py\n")


def test_a_typo_never_trains(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "eval", "--set", "runner.max_epoch+=2")
    assert ended.code == 2
    assert "ToyTrainRunner takes no 'max_epoch'" in ended.err
    assert not Path("work_dirs").exists()


def test_a_work_dir_that_cannot_be_written(
    run: Fluxvla, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    write("taken", "a file")
    ended = run("--config", "c.py", "--section", "runner", "--work-dir", "taken")
    assert ended.code == 2
    assert ended.err == (
        "taken: cannot write to the work dir: File exists\n"
        "  next: name another one: --work-dir DIR\n"
    )

    def refuse(**kwargs: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(atomic.tempfile, "TemporaryFile", refuse)
    ended = run("--config", "c.py", "--section", "runner")
    assert ended.code == 2
    assert "work_dirs/c: cannot write to the work dir: Permission denied" in ended.err


def test_a_fresh_training_does_not_land_on_another(run: Fluxvla, write: Write) -> None:
    for step in (100, 200):
        write(f"work_dirs/c/checkpoints/step-{step:09}/manifest.json", "{}")
    ended = run("--config", "c.py", "--section", "runner")
    assert ended.code == 2
    assert ended.err == (
        "work_dirs/c: the work dir already holds checkpoints, up to step 200\n"
        "  next: resume from there: --resume auto; or use another folder: --work-dir DIR\n"
    )
    assert run("--config", "c.py", "--section", "eval").code == 0
    ended = run("--config", "c.py", "--section", "runner", "--resume", "auto")
    assert ended.code == 0, ended.err
    assert said()["resume"] == "auto"


def test_nor_does_one_that_goes_on_from_elsewhere(run: Fluxvla, write: Write) -> None:
    """A restart would go on from what lies there, whatever was asked for."""
    for work_dir in ("work_dirs/c", "other"):
        write(f"{work_dir}/checkpoints/step-000000100/manifest.json", "{}")
    words = ("--config", "c.py", "--section", "runner")
    ended = run(*words, "--resume", "other", "--max-restarts", "1")
    assert ended.code == 2
    assert "work_dirs/c: the work dir already holds checkpoints" in ended.err
    for place, code in (
        ("auto", 0),
        ("work_dirs/c/checkpoints/step-000000100", 0),
        ("work_dirs/c", 0),
        ("other", 2),
        ("", 2),
    ):
        write("resumes.py", f"{CONFIG}runner['resume_from'] = {place!r}\n")
        ended = run("--config", "resumes.py", "--section", "runner", "--work-dir", "work_dirs/c")
        assert (ended.code, "already holds" in ended.err) == (code, code == 2)


def test_options_that_do_not_fit_the_section(run: Fluxvla) -> None:
    assert (
        "--task says what a robot is to do, and section 'runner' trains"
        in run("--config", "c.py", "--section", "runner", "--task", "1").err
    )
    assert (
        "--resume is for training, and section 'eval' does not train"
        in run("--config", "c.py", "--section", "eval", "--resume", "auto").err
    )
    ended = run("--config", "c.py", "--section", "runner", "--resume", "gone")
    assert ended.code == 2
    assert "--resume gone: there is no such checkpoint" in ended.err
    assert "--resume auto takes the newest one" in ended.err


def test_several_processes_for_a_runner_that_is_one(run: Fluxvla, write: Write) -> None:
    words = ("--config", "c.py", "--section", "eval")
    write("toy.py", Path("toy.py").read_text().replace("workers=None, ", ""))
    ended = run(*words, "--nproc", "2")
    assert ended.code == 2
    assert ended.err == (
        "--nproc is for processes that train or evaluate together, and section 'eval' runs in "
        "one\n  next: leave it out\n"
    )
    assert not Path("work_dirs").exists()
    assert run(*words, "--nproc", "1").code == 0
    text = Path("toy.py").read_text().replace("seeds=1, context=None", "context=None, **kwargs")
    write("toy.py", text)
    assert run(*words, "--nproc", "2").code == 0, "whatever it does with it"


# -- endings ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mode", "code", "err"),
    [
        ("denied", 2, "a.mp4: bad data\n  next: look at it\n"),
        (
            "full",
            1,
            "no space left on the disk while writing big.bin\n"
            "  next: make room and run the same command again, training with --resume auto\n",
        ),
        (
            "ctrl-c",
            130,
            "interrupted: saved at step 3\n  next: run the same command again with --resume auto\n",
        ),
        ("sigterm", 1, "stopped by SIGTERM\n"),
    ],
)
def test_endings(run: Fluxvla, mode: str, code: int, err: str) -> None:
    before = signal.getsignal(signal.SIGTERM)
    ended = run("--config", "c.py", "--section", "runner", "--set", f"runner.mode+={mode}")
    assert (ended.code, ended.err) == (code, err)
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_bug_in_a_runner_shows_its_line(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "runner", "--set", "runner.mode+=boom")
    assert ended.code == 1
    assert 'raise ValueError("boom")' in ended.err


def test_a_run_outside_of_the_main_thread_leaves_signals_alone(run: Fluxvla) -> None:
    codes: list[int] = []
    words = ("--config", "c.py", "--section", "eval")
    thread = threading.Thread(target=lambda: codes.append(run(*words).code))
    thread.start()
    thread.join()
    assert codes == [0]


def test_other_os_errors_are_not_called_a_full_disk(run: Fluxvla, write: Write) -> None:
    write("work_dirs/c/said-0.json/taken", "")
    ended = run("--config", "c.py", "--section", "runner")
    assert ended.code == 1
    assert "IsADirectoryError" in ended.err
    assert "no space" not in ended.err


# -- dry runs --------------------------------------------------------------------------------


def test_a_dry_run_builds_nothing(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "runner", "--dry-run", "--nproc", "2")
    assert ended.code == 0
    assert ended.out.startswith(
        "section: runner (trains)\n"
        "work dir: work_dirs/c\n"
        "plugins:\n"
        "  train_dataloader.dataset  ToyDataset      registered in this process\n"
    )
    assert "  runner.max_epochs = 1" in ended.out
    assert ended.out.rstrip().endswith("# c.py:4")
    assert not Path("work_dirs").exists()


def test_a_dry_run_for_machines(run: Fluxvla) -> None:
    ended = run("--config", "c.py", "--section", "eval", "--dry-run", "--log-format", "json")
    outline = json.loads(ended.out)
    assert (outline["section"], outline["trains"]) == ("eval", False)
    assert outline["origins"]["runner.max_epochs"] == "c.py:3"
    assert {
        "key": "eval",
        "type": "ToyEvalRunner",
        "provided_by": "registered in this process",
    } in (outline["plugins"])


# -- --plugin --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("gone.py", None, "--plugin gone.py: there is no such file"),
        ("x.txt", "", "--plugin x.txt: not a .py file"),
        ("x.py", "a = 1\n1 / 0\n", "x.py:2: --plugin x.py: raised ZeroDivisionError"),
        ("x.py", "a = (\n", "x.py:1: --plugin x.py: raised SyntaxError"),
        (
            "x.py",
            "from fluxvla_core import RUNNERS\n@RUNNERS.register_module()\nclass X: ...\n",
            "X does not fulfil the contract of fluxvla.runners",
        ),
    ],
)
def test_plugin_files_that_cannot_be_used(
    fluxvla: Fluxvla, write: Write, name: str, text: str | None, message: str
) -> None:
    if text is not None:
        write(name, text)
    ended = fluxvla("run", "--config", "c.py", "--plugin", name)
    assert ended.code == 2
    assert message in ended.err


@pytest.mark.parametrize(
    ("file", "folder"),
    [
        ("configs/x.py", "work_dirs/x"),
        ("y.toml", "work_dirs/y"),
        ("out/run/config.resolved.json", "out/run"),
        ("out/run/checkpoints/step-000000001/config.resolved.json", "out/run"),
        ("out/eval/config.resolved.json", "out/eval"),
        ("trained/eval/config.resolved.json", "trained"),
        ("trained/other/config.resolved.json", "trained/other"),
        ("exported/config.resolved.json", "work_dirs/exported"),
        ("other.json", "work_dirs/other"),
    ],
)
def test_default_work_dirs(write: Write, file: str, folder: str) -> None:
    write("trained/config.resolved.json", "{}")
    write("exported/manifest.json", "{}")
    assert default_work_dir(Path(file), ["eval", "inference"]) == Path(folder)


@pytest.mark.parametrize(
    ("words", "taken"),
    [
        ((), "out/checkpoints/step-000000003"),
        (("--set", "eval.ckpt_path=mine"), "mine"),
    ],
)
def test_the_config_of_a_checkpoint_means_that_checkpoint(
    run: Fluxvla, write: Write, words: tuple[str, ...], taken: str
) -> None:
    folder = "out/checkpoints/step-000000003"
    toy = TOY.replace("seeds=1, workers", "seeds=1, ckpt_path=None, workers")
    write(
        "toy.py", toy.replace("{self.context.nproc}", "{self.context.config['eval']['ckpt_path']}")
    )
    config = apply_overrides(load_config("c.py"), ["eval.ckpt_path+=another"])
    write(f"{folder}/manifest.json", "{}")
    write_resolved(Path(folder, "config.resolved.json"), config)
    ended = run("--config", f"{folder}/config.resolved.json", "--section", "eval", *words)
    assert ended.code == 0, ended.err
    assert Path("out/eval.txt").read_text().split()[-1] == taken


REFUSING = """
from fluxvla_core import RUNNERS
from fluxvla_core.errors import ConfigError

@RUNNERS.register_module()
class RefusingRunner:
    def __init__(self, late=False, context=None):
        self.late, self.folder = late, context.work_dir

    def run_setup(self):
        if self.late:
            (self.folder / "found.txt").touch()
        raise ConfigError("this cannot be meant")

    def run(self): ...
"""


def test_a_refused_run_leaves_no_work_dir(fluxvla: Fluxvla, write: Write) -> None:
    write("refusing.py", REFUSING)
    write("r.toml", "[eval]\ntype = 'RefusingRunner'\n")
    words = ("run", "--plugin", "refusing.py", "--config", "r.toml", "--work-dir")
    ended = fluxvla(*words, "new/deep/work")
    assert (ended.code, ended.err) == (2, "this cannot be meant\n")
    assert not Path("new").exists()
    RUNNERS.unregister("RefusingRunner")
    assert fluxvla(*words, "kept/work", "--set", "eval.late=true").code == 2
    assert Path("kept/work/found.txt").exists()
    RUNNERS.unregister("RefusingRunner")
    write("mine/config.resolved.json", "{}")
    assert fluxvla(*words, "mine").code == 2
    assert [p.name for p in Path("mine").iterdir()] == ["config.resolved.json"]
    RUNNERS.unregister("RefusingRunner")


def test_ctrl_c_says_how_an_evaluation_goes_on(fluxvla: Fluxvla, write: Write) -> None:
    text = REFUSING.replace("late=False", "episodes=1, late=False")
    refused = 'raise ConfigError("this cannot be meant")'
    write("refusing.py", text.replace(refused, "raise KeyboardInterrupt"))
    write("r.toml", "[eval]\ntype = 'RefusingRunner'\n")
    ended = fluxvla("run", "--plugin", "refusing.py", "--config", "r.toml")
    assert (ended.code, ended.err) == (
        130,
        "interrupted: finished episodes are kept\n  next: run the same command again\n",
    )
    RUNNERS.unregister("RefusingRunner")
