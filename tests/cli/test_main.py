"""Commands, arguments, exit codes, and what is not imported."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from fluxvla_core.cli import main as main_module
from fluxvla_core.cli.main import COMMANDS, Entry, main
from fluxvla_core.errors import DataError
from tests.conftest import Install

from .conftest import Fluxvla, Write

BASIC = {"PATH": "/usr/bin:/bin"}


@pytest.mark.parametrize("words", [(), ("--help",), ("-h",), ("help",)])
def test_help_lists_the_commands(fluxvla: Fluxvla, words: tuple[str, ...]) -> None:
    ended = fluxvla(*words)
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.startswith("usage: fluxvla COMMAND")
    for name in COMMANDS:
        assert f"  {name} " in ended.out


def test_every_command_has_help_and_a_contract(fluxvla: Fluxvla) -> None:
    for name in COMMANDS:
        ended = fluxvla(*name.split(), "--help")
        assert ended.code == 0
        assert f"usage: fluxvla {name}" in ended.out


def test_groups_of_commands(fluxvla: Fluxvla) -> None:
    for words in (("plugins",), ("plugins", "--help")):
        ended = fluxvla(*words)
        assert ended.code == 0
        assert "plugins doctor" in ended.out
        assert "config" not in ended.out
    assert fluxvla("plugins", "lst") == (
        type(ended)(
            2,
            "",
            "fluxvla plugins has no 'lst'; did you mean 'fluxvla plugins list'?\n"
            "  next: fluxvla plugins --help\n",
        )
    )
    assert "fluxvla config has no 'zzz'\n" in fluxvla("config", "zzz").err


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("rnu",), "no command 'rnu'; did you mean 'fluxvla run'?\n  next: fluxvla --help"),
        (("plugin",), "no command 'plugin'; did you mean 'fluxvla plugins'?"),
        (("zzz",), "no command 'zzz'\n"),
        (("--config", "x"), "unknown argument '--config': the command comes first"),
        (
            ("run", "--confg", "x"),
            "fluxvla run: unknown argument '--confg'; did you mean --config?\n"
            "  next: fluxvla run --help",
        ),
        (("run", "--conf", "x"), "unknown argument '--conf'; did you mean --config?"),
        (("run", "--resume_from=x"), "unknown argument '--resume_from=x'; did you mean --resume?"),
        (("run", "c.py"), "unknown argument 'c.py'; did you mean --config c.py?"),
        (("run", "--config", "c.py", "d.py"), "unknown argument 'd.py'\n"),
        (("version", "x"), "unknown argument 'x'\n"),
        (("run", "--config"), "argument --config: expected one argument"),
        (("run", "--config", "a", "--config", "b"), "--config is given twice"),
        (("run", "--nproc", "0"), "argument --nproc: 0 is less than 1"),
        (("run", "--nproc", "two"), "argument --nproc: invalid positive value: 'two'"),
        (("run", "--log-format", "xml"), "argument --log-format: invalid choice: 'xml'"),
        (("config", "show"), "the following arguments are required: file"),
    ],
)
def test_bad_command_lines(fluxvla: Fluxvla, words: tuple[str, ...], text: str) -> None:
    ended = fluxvla(*words)
    assert (ended.code, ended.out) == (2, "")
    assert text in ended.err


def test_version(fluxvla: Fluxvla) -> None:
    for words in (("version",), ("--version",)):
        ended = fluxvla(*words)
        assert ended.code == 0
        assert ended.out.startswith("fluxvla-core 0.")
        assert "Python 3." in ended.out


class Toy:
    """Raises what it is told to."""

    help = "A toy."
    error: BaseException = ValueError("boom")

    def add_arguments(self, parser: object) -> None: ...

    def run(self, args: object) -> int:
        raise self.error


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> type[Toy]:
    monkeypatch.setattr(
        main_module, "COMMANDS", {**COMMANDS, "toy": Entry(f"{__name__}:Toy", "a toy")}
    )
    return Toy


@pytest.mark.parametrize(
    ("error", "code", "err"),
    [
        (DataError("bad", where="a.mp4", next="look"), 2, "a.mp4: bad\n  next: look\n"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
        (KeyboardInterrupt("saved at step 3"), 130, "interrupted: saved at step 3\n"),
        (SystemExit(3), 3, ""),
        (SystemExit(), 0, ""),
        (SystemExit("gone"), 1, "gone\n"),
        (BrokenPipeError(), 1, ""),
    ],
)
def test_exit_codes(
    fluxvla: Fluxvla,
    toy: type[Toy],
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException,
    code: int,
    err: str,
) -> None:
    monkeypatch.setattr(toy, "error", error)
    stdout = sys.stdout
    ended = fluxvla("toy")
    sys.stdout = stdout
    assert (ended.code, ended.err) == (code, err)


def test_an_unexpected_exception_keeps_its_traceback(fluxvla: Fluxvla, toy: type[Toy]) -> None:
    ended = fluxvla("toy")
    assert ended.code == 1
    assert ended.err.startswith("Traceback (most recent call last)")
    assert ended.err.endswith("ValueError: boom\n")


def test_strict_mode_gives_every_traceback(
    fluxvla: Fluxvla, toy: type[Toy], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(toy, "error", DataError("bad"))
    monkeypatch.setenv("FLUXVLA_STRICT", "1")
    ended = fluxvla("toy")
    assert ended.code == 2
    assert ended.err.startswith("Traceback")
    assert ended.err.endswith("DataError: bad\n")


# -- commands of plugins ---------------------------------------------------------------------

COMMAND = """
class Greet:
    api = "1.0"
    help = "Greets."
    def add_arguments(self, parser):
        parser.add_argument("--name", required=True)
    def run(self, args):
        print("hello", args.name)
        return 7
"""


def test_a_plugins_command_is_listed_without_importing_and_run_by_name(
    fluxvla: Fluxvla, install: Install
) -> None:
    install(
        "acme-greet",
        entry_points="[fluxvla.commands]\ngreet = acme_greet:Greet\n",
        files={"acme_greet.py": COMMAND},
    )
    assert re.search(r"greet +Greets \(from acme-greet 1\.0\)", fluxvla("--help").out)
    assert "acme_greet" not in sys.modules
    assert "no command 'gret'; did you mean 'fluxvla greet'?" in fluxvla("gret").err
    ended = fluxvla("greet", "--name", "you")
    assert (ended.code, ended.out) == (7, "hello you\n")
    assert (
        "unknown argument '--nam'; did you mean --name?"
        in fluxvla("greet", "--name", "x", "--nam", "y").err
    )
    assert "Greets." in fluxvla("greet", "--help").out


def test_a_known_command_that_is_not_installed_says_how_to_get_it(
    fluxvla: Fluxvla, install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FLUXVLA_PLUGINS", "")
    install("acme-greet", entry_points="", files={})  # the index is made anew
    assert fluxvla("report", "work").err == (
        "fluxvla report comes with fluxvla-report, which is not installed\n"
        "  next: pip install fluxvla-report\n"
    )


def test_a_broken_command_hurts_only_itself(fluxvla: Fluxvla, install: Install) -> None:
    install("acme-greet", entry_points="[fluxvla.commands]\ngreet = acme_gone:Greet\n")
    assert fluxvla("--help").code == 0
    ended = fluxvla("greet")
    assert ended.code == 2
    assert "acme-greet 1.0 provides 'greet' but its own module 'acme_gone' is missing" in ended.err


# -- subprocesses ----------------------------------------------------------------------------


def modules_after(words: list[str], cwd: Path, tmp_path: Path) -> set[str]:
    """Run ``fluxvla words`` in a process of its own; the modules that it had at the end."""
    listed = tmp_path / "modules.txt"
    code = (
        "import sys\n"
        "from fluxvla_core.cli.main import main\n"
        f"code = main({words!r})\n"
        f"open({str(listed)!r}, 'w').write('\\n'.join(sys.modules))\n"
        "sys.exit(code)\n"
    )
    subprocess.run(
        [sys.executable, "-c", code], cwd=cwd, check=True, capture_output=True, env=BASIC
    )
    return {name.partition(".")[0] for name in listed.read_text().splitlines()}


@pytest.mark.parametrize(
    "words",
    [
        ["--help"],
        ["plugins", "list"],
        ["plugins", "show", "DictCollator"],
        ["config", "check", "--plugin", "toy.py", "c.py"],
    ],
)
def test_light_commands_import_nothing_heavy(
    write: Write, tmp_path: Path, words: list[str]
) -> None:
    found = modules_after(words, Path.cwd(), tmp_path)
    heavy = {"torch", "numpy", "cv2", "pyarrow", "av", "rich", "transformers", "rclpy", "pluggy"}
    assert found & heavy == set()
    if words == ["--help"]:
        assert "argparse" not in found


def test_python_m_is_the_same_command(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "fluxvla_core", "run"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=BASIC,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("no config given: fluxvla run --config FILE")


def test_a_reader_that_leaves_early_is_no_error(tmp_path: Path) -> None:
    read, written = os.pipe()
    os.close(read)
    done = subprocess.run(
        [sys.executable, "-u", "-m", "fluxvla_core", "plugins", "list"],
        stdout=written,
        stderr=subprocess.PIPE,
        text=True,
        env=BASIC,
        check=False,
    )
    os.close(written)
    assert (done.returncode, done.stderr) == (1, "")


def test_main_takes_the_process_arguments(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["fluxvla", "version"])
    assert main() == 0
    assert capsys.readouterr().out.startswith("fluxvla-core")
