"""Commands run in sight of the user."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from tools import shell


def test_output_is_kept_back_only_when_quiet(capfd: pytest.CaptureFixture[str]) -> None:
    assert shell.run([sys.executable, "-c", "print('seen')"]) == ""
    seen = capfd.readouterr().out
    assert seen.splitlines()[0].startswith("$ ")
    assert "seen" in seen.splitlines()
    kept = shell.run([sys.executable, "-c", "print('kept')"], quiet=True, echo=False)
    assert kept == "kept\n"
    assert capfd.readouterr().out == ""


def test_a_failing_command_is_named_with_its_status_and_output() -> None:
    program = "import sys; print('the reason', file=sys.stderr); sys.exit(3)"
    with pytest.raises(shell.StepFailed, match="exit status 3 from: ") as failure:
        shell.run([sys.executable, "-c", program], quiet=True)
    assert failure.value.status == 3
    assert failure.value.output == "the reason\n"
    assert failure.value.command[0] == sys.executable


def test_a_program_that_is_not_there_is_status_127(tmp_path: Path) -> None:
    with pytest.raises(shell.StepFailed, match="exit status 127") as failure:
        shell.run([tmp_path / "no-such-program"])
    assert "no-such-program" in failure.value.output


def test_what_is_said_to_this_python_does_not_reach_the_child(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    said = {"PYTHONPATH": "/elsewhere", "PYTHONHOME": "/elsewhere", "PYTHONDONTWRITEBYTECODE": "1"}
    for name, value in said.items():
        monkeypatch.setenv(name, value)
    env = shell.child_environment({"EXTRA": "1"})
    assert not said.keys() & env.keys()
    assert env["EXTRA"] == "1"
    assert env["PATH"] == os.environ["PATH"]


def test_ctrl_c_lets_the_child_finish_what_it_must(tmp_path: Path) -> None:
    child = textwrap.dedent("""
        import pathlib, sys, time
        time.sleep(0.5)  # the parent may not wait for it yet
        try:
            pathlib.Path("started").touch()
            time.sleep(60)
        except KeyboardInterrupt:
            time.sleep(0.5)
            pathlib.Path("saved").touch()
            sys.exit(130)
    """)
    parent = (
        "import sys; from tools import shell\n"
        f"try: shell.run([sys.executable, '-c', {child!r}], echo=False)\n"
        "except KeyboardInterrupt: sys.exit(7)"
    )
    root = str(Path(__file__).parents[2])
    process = subprocess.Popen(
        [sys.executable, "-c", parent],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": root},
        start_new_session=True,
    )
    deadline = time.monotonic() + 30
    while not (tmp_path / "started").exists():
        assert time.monotonic() < deadline, "the child did not start"
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(timeout=30) == 7
    assert (tmp_path / "saved").exists()


def test_a_command_beside_is_waited_for_and_shown_only_if_it_fails(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    program = textwrap.dedent("""
        import pathlib, sys, time
        while not pathlib.Path("go").exists():
            time.sleep(0.01)
        print("what it says")
        pathlib.Path("done").touch()
        sys.exit(int(sys.argv[1]))
    """)
    for status in (0, 3):
        with shell.alongside([sys.executable, "-c", program, str(status)], cwd=tmp_path):
            (tmp_path / "go").touch()
        (tmp_path / "done").unlink()
        (tmp_path / "go").unlink()
        said = capfd.readouterr().out
        assert (f"exit status {status} from: " in said) == bool(status)
        assert ("\nwhat it says\n" in said) == bool(status)


def test_a_command_beside_a_failing_one_is_ended(tmp_path: Path) -> None:
    program = "import os, pathlib, time; pathlib.Path(str(os.getpid())).touch(); time.sleep(600)"
    other = shell.StepFailed(["other"], 1)

    def fails() -> None:
        with shell.alongside([sys.executable, "-c", program], cwd=tmp_path):
            while not list(tmp_path.iterdir()):
                time.sleep(0.01)
            raise other

    with pytest.raises(shell.StepFailed, match="other"):
        fails()
    (begun,) = tmp_path.iterdir()
    with pytest.raises(ProcessLookupError):
        os.kill(int(begun.name), 0)
