"""``fluxvla run`` with bad input, and how a run that fails or is stopped ends."""

from __future__ import annotations

import signal
import threading
from pathlib import Path

import pytest

from fluxvla_core import RUNNERS, atomic
from tests.cli.messages import said

from .conftest import CONFIG, Fluxvla, Write


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
