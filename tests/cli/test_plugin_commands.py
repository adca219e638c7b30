"""``fluxvla plugins list``, ``show`` and ``doctor``."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable

import pytest

from fluxvla_core.plugins import _metadata
from tests.conftest import Install

from .conftest import Fluxvla

ARM = '''
from fluxvla_core.robot import nothing
class Base:
    def __init__(self, rate: int = 30, context=None, **extra): ...
class Arm(Base):
    """Moves things.

    Carefully.
    """
    api = "1.0"
    def __init__(self, port: str, **kwargs):
        super().__init__(**kwargs)
'''


@pytest.fixture
def arm(install: Install) -> Install:
    install(
        "acme-arm",
        version="2.1",
        entry_points="[fluxvla.operators]\nArm = acme_arm:Arm\n",
        files={"acme_arm.py": ARM},
    )
    return install


@pytest.mark.parametrize(
    ("command", "said"),
    [("list", "1 distribution(s) could not be read"), ("doctor", "METADATA")],
)
def test_a_pipe_for_metadata_keeps_no_command_waiting(
    install: Install, command: str, said: str
) -> None:
    """As commands of their own: one that waited would wait for ever."""
    folder = install("acme-pipe", entry_points="[fluxvla.operators]\nPipe = acme_pipe:Pipe\n")
    (folder / "METADATA").unlink()
    os.mkfifo(folder / "METADATA")
    ended = subprocess.run(
        [sys.executable, "-m", "fluxvla_core", "plugins", command],
        env={**os.environ, "PYTHONPATH": str(folder.parent)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert said in ended.stdout + ended.stderr
    assert "Traceback" not in ended.stderr


def test_list(fluxvla: Fluxvla, arm: Install) -> None:
    ended = fluxvla("plugins", "list")
    assert (ended.code, ended.err) == (0, "")
    lines = ended.out.splitlines()
    at = lines.index("fluxvla.operators")
    assert any(line.split() == ["Arm", "acme-arm", "2.1"] for line in lines[at + 1 :])
    assert "acme_arm" not in sys.modules


def test_list_for_machines(fluxvla: Fluxvla, arm: Install) -> None:
    records = json.loads(fluxvla("plugins", "list", "--json").out)
    assert {
        "group": "fluxvla.operators",
        "name": "Arm",
        "distribution": "acme-arm",
        "version": "2.1",
        "value": "acme_arm:Arm",
    } in records


def test_a_broken_distribution_is_reported_and_hurts_nobody(fluxvla: Fluxvla, arm: Install) -> None:
    arm("acme-broken", entry_points="[fluxvla.operators]\nno equals sign\n")
    ended = fluxvla("plugins", "list")
    assert ended.code == 0
    assert "acme-arm 2.1" in ended.out
    assert ended.err == "1 distribution(s) could not be read; run: fluxvla plugins doctor\n"


def test_nothing_installed(fluxvla: Fluxvla, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fluxvla_core.cli.plugin_commands.index", lambda: _metadata.Index({}, ()))
    assert fluxvla("plugins", "list").out == "nothing is installed\n"


def test_show(fluxvla: Fluxvla, arm: Install) -> None:
    for name in ("Arm", "Acme_Arm:Arm"):
        ended = fluxvla("plugins", "show", name)
        assert ended.code == 0
        assert ended.out == (
            "fluxvla.operators Arm\n"
            "  provided by  acme-arm 2.1 (acme_arm:Arm)\n"
            "  defined at   acme_arm.py:5\n"
            "  contract     operators 1.0\n"
            "  about        Moves things.\n"
            "  process      runs as a whole in a process of its own, which sends commands and also "
            "copies its images: its own code that keeps the interpreter's lock delays commands\n"
            "  keys\n"
            "    port: str   [required]\n"
            "    rate: int = 30\n"
            "    context = None   [filled in when the run starts]\n"
            "    ...   [takes further keys, which cannot be checked]\n"
        )
    assert "acme_arm" not in sys.modules


def test_show_of_what_takes_nothing_or_cannot_be_read(fluxvla: Fluxvla, install: Install) -> None:
    install(
        "acme-bare",
        entry_points="[fluxvla.heads]\nBare = acme_bare:Bare\nMade = acme_bare:Made\n"
        "Lost = acme_lost:Lost\n",
        files={"acme_bare.py": "class Bare: ...\nMade = make()\n"},
    )
    assert fluxvla("plugins", "show", "Bare").out.endswith("  keys         none\n")
    assert (
        "source       cannot be read; its keys are not checked"
        in fluxvla("plugins", "show", "Made").out
    )
    assert (
        "cannot work  acme-bare 1.0 provides 'Lost' but its module 'acme_lost'"
        in fluxvla("plugins", "show", "Lost").out
    )


def test_show_says_what_each_key_means(fluxvla: Fluxvla, install: Install) -> None:
    files = {
        "acme_doc.py": '''raise RuntimeError("show must not import")
class Base:
    """A base.

    Args:
        rate: commands a second,
            by default 30.
        topic: of the base.
    """
    def __init__(self, rate=30, topic="/b"): ...
class Arm(Base):
    """An arm.

    Args:
        topic: where it listens.
    """
    def __init__(self, topic="/a", **kwargs):
        super().__init__(**kwargs)
'''
    }
    points = "[fluxvla.operators]\nDocumented = acme_doc:Arm\n"
    install("acme-doc", entry_points=points, files=files)
    assert fluxvla("plugins", "show", "Documented").out.endswith(
        "  keys\n    topic = '/a'\n        where it listens.\n"
        "    rate = 30\n        commands a second, by default 30.\n"
    )


DIVIDED = """raise RuntimeError("show must not import")
from fluxvla_core.operators import Operator
from elsewhere import Unknown
class Whole(Operator):
    def connect(self): raise RuntimeError("show must not connect")
class Divided(Operator):
    def without_cameras(self):
        return self
    def without_commands(self):
        return self
class Inherits(Divided): ...
class Duck:
    def without_cameras(self): return self
class Hidden(Unknown): ...
def make(): ...
"""


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Whole", "runs as a whole in a process of its own, which sends commands and also copies"),
        ("Divided", "can be divided: commands are sent from a process of its own\n"),
        ("Inherits", "can be divided: "),
        ("Duck", "can be divided: "),
        ("Hidden", "not known: its source, or that of a base class, cannot be read\n"),
        ("make", "not known: "),
    ],
)
def test_show_says_whether_an_operator_can_be_divided(
    fluxvla: Fluxvla, install: Install, name: str, said: str
) -> None:
    points = f"[fluxvla.operators]\n{name} = acme_divided:{name}\n"
    install("acme-divided", entry_points=points, files={"acme_divided.py": DIVIDED})

    assert f"\n  process      {said}" in fluxvla("plugins", "show", name).out


def test_show_says_nothing_of_processes_where_there_is_no_operator(fluxvla: Fluxvla) -> None:
    assert "process" not in fluxvla("plugins", "show", "LowPass").out


def test_show_of_two_with_one_name(fluxvla: Fluxvla, arm: Install) -> None:
    arm("other-arm", entry_points="[fluxvla.operators]\nArm = acme_arm:Arm\n")
    out = fluxvla("plugins", "show", "Arm").out
    assert "acme-arm 2.1" in out
    assert "other-arm 1.0" in out


def test_show_of_nothing(fluxvla: Fluxvla, arm: Install, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = fluxvla("plugins", "show", "Amr")
    assert ended.code == 2
    assert ended.err == (
        "nothing installed is called 'Amr'; did you mean 'Arm'?\n  next: fluxvla plugins list\n"
    )
    monkeypatch.setenv("FLUXVLA_PLUGINS", "")
    _metadata.index.cache_clear()
    assert fluxvla("plugins", "show", "FSDPTrainRunner").err == (
        "'FSDPTrainRunner' is provided by fluxvla-fsdp, which is not installed: "
        "pip install fluxvla-fsdp\n"
    )


def test_doctor_finds_what_is_wrong(fluxvla: Fluxvla, arm: Install) -> None:
    arm("acme-broken", entry_points="[fluxvla.operators]\nno equals sign\n")
    arm("other-arm", entry_points="[fluxvla.operators]\nArm = acme_arm:Arm\n")
    arm(
        "acme-odd",
        entry_points=(
            "[fluxvla.operator]\nOdd = acme_arm:Arm\n"
            "[fluxvla.zzz]\nOdder = acme_arm:Arm\n"
            "[fluxvla.commands]\nrun = acme_arm:Arm\n"
            "[fluxvla.heads]\nGone = acme_gone:X\nTypo = acme_arm:Amr\n"
        ),
    )
    arm(
        "acme-picky",
        entry_points="[fluxvla.heads]\nPicky = acme_arm:Arm\n",
        requires=("fluxvla-core>=99",),
    )
    ended = fluxvla("plugins", "doctor", "--no-import")
    assert ended.code == 1
    for text in (
        "acme_broken-1.0.dist-info: ",
        "fluxvla.operators: 'Arm' is provided by acme-arm 2.1, other-arm 1.0; "
        "write type='<distribution>:Arm' to choose, or uninstall one",
        "acme-odd 1.0: Odd is in 'fluxvla.operator', which nothing reads; "
        "did its author mean 'fluxvla.operators'?",
        "acme-odd 1.0: Odder is in 'fluxvla.zzz', which nothing reads",
        "acme-odd 1.0: the command 'run' is the core's own; rename it",
        "fluxvla.heads: acme-odd 1.0 provides 'Gone' but its module 'acme_gone' is missing "
        "(a stale or orphaned install): reinstall acme-odd",
        "fluxvla.heads: acme-odd 1.0: entry point Typo = 'acme_arm:Amr' names an object that "
        "does not exist",
        "fluxvla.heads: acme-picky 1.0 needs fluxvla-core>=99, but ",
    ):
        assert text in ended.out, text
    assert "acme_arm" not in sys.modules


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Call it, and only distributions called ``acme-…`` are installed."""

    def leave() -> None:
        every = _metadata.index()
        ours = {k: v for k, v in every.plugins.items() if v[0].dist.startswith("acme-")}
        index = _metadata.Index(ours, ())
        monkeypatch.setattr("fluxvla_core.cli.plugin_commands.index", lambda: index)

    return leave


DESK = "class Desk:\n    def get_frame(self): ...\n"


def entry(name: str, module: str) -> str:
    return f"[fluxvla.operators]\n{name} = {module}:{name}\n"


def test_doctor_of_a_sound_installation(
    fluxvla: Fluxvla, install: Install, alone: Callable[[], None]
) -> None:
    """What a robot needs when it is connected, or prints when it is imported, is not a problem."""
    lazy = "print('hello')\nclass Lazy:\n    def get_frame(self): import acme_vendor_sdk\n"
    install("acme-lazy", entry_points=entry("Lazy", "lazy"), files={"lazy.py": lazy})
    install("acme-desk", entry_points=entry("Desk", "desk"), files={"desk.py": DESK})
    alone()
    ended = fluxvla("plugins", "doctor")
    assert (ended.code, ended.out) == (0, "no problems: 2 plugin(s) of 2 distribution(s)\n")
    assert {"lazy", "desk"} & set(sys.modules) == set()


BROKEN = {
    "acme_needs.py": "import acme_vendor_sdk\nclass Needs: ...\n",
    "acme_raises.py": "def look():\n    raise OSError('no display')\nlook()\nclass Raises: ...\n",
    "acme_exits.py": "import os\nos._exit(3)\nclass Exits: ...\n",
    "acme_dies.py": "import os, signal\nos.kill(os.getpid(), signal.SIGKILL)\nclass Dies: ...\n",
    "acme_lacks.py": "class Lacks: ...\n",
    "acme_inner/__init__.py": "",
    "acme_inner/robot.py": "from .driver import Driver\nclass Inner: ...\n",
    "acme_inner/driver.py": "class Driver:\n    def move(self:\n",
}


def test_doctor_imports_and_names_each_that_is_broken(
    fluxvla: Fluxvla, install: Install, alone: Callable[[], None]
) -> None:
    for name in ("Needs", "Raises", "Exits", "Dies", "Lacks"):
        module = f"acme_{name.lower()}"
        install(f"acme-{name.lower()}", entry_points=entry(name, module))
    install("acme-inner", entry_points=entry("Inner", "acme_inner.robot"), files=BROKEN)
    install("acme-desk", entry_points=entry("Desk", "desk"), files={"desk.py": DESK})
    alone()
    ended = fluxvla("plugins", "doctor")
    assert ended.code == 1
    shows = "; FLUXVLA_STRICT=1 fluxvla plugins doctor shows the traceback"
    assert sorted(ended.out.splitlines()) == [
        f"fluxvla.operators: {text}"
        for text in (
            "acme-dies 1.0 provides 'Dies' but importing 'acme_dies' ended the interpreter "
            "(SIGKILL); python -X faulthandler -c 'import acme_dies' shows where",
            "acme-exits 1.0 provides 'Exits' but importing 'acme_exits' ended the interpreter "
            "(exit status 3); python -X faulthandler -c 'import acme_exits' shows where",
            "acme-inner 1.0 provides 'Inner' but raised SyntaxError on import: '(' was never "
            f"closed (acme_inner/driver.py:2){shows}",
            "acme-lacks 1.0: Lacks does not fulfil the contract of fluxvla.operators: get_frame() "
            "is missing; see docs/writing-a-plugin.md for what each contract asks for",
            "acme-needs 1.0 provides 'Needs' but it needs 'acme_vendor_sdk', which is not "
            "installed (acme_needs.py:1); pip install acme-needs again with its dependencies, or "
            "install acme_vendor_sdk",
            "acme-raises 1.0 provides 'Raises' but raised OSError on import: no display "
            f"(acme_raises.py:2){shows}",
        )
    ]
    looked = fluxvla("plugins", "doctor", "--no-import")
    assert looked.code == 0
    assert looked.out.startswith("no problems in metadata and sources: 7 plugin(s)")


def test_doctor_shows_tracebacks_when_it_is_asked_to(
    fluxvla: Fluxvla, install: Install, alone: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    install("acme-raises", entry_points=entry("Raises", "acme_raises"), files=BROKEN)
    alone()
    monkeypatch.setenv("FLUXVLA_STRICT", "1")
    out = fluxvla("plugins", "doctor").out
    assert 'acme_raises.py", line 2, in look' in out
    assert "OSError: no display" in out


def test_doctor_ends_an_import_that_hangs(
    fluxvla: Fluxvla, install: Install, alone: Callable[[], None]
) -> None:
    points = "[fluxvla.operators]\nDesk = desk:Desk\nWaits = acme_a:Waits\nAlso = acme_a:Also\n"
    hangs = "import time\ntime.sleep(3600)\nclass Waits: ...\nclass Also: ...\n"
    files = {"acme_a.py": hangs, "desk.py": DESK}
    install("acme-waits", entry_points=points, files=files)
    alone()
    ended = fluxvla("plugins", "doctor", "--limit", "1")
    assert ended.code == 1
    assert sorted(ended.out.splitlines()) == [
        f"fluxvla.operators: acme-waits 1.0 provides {name!r} but importing 'acme_a' did not end "
        "in 1 s; Desk not tried after that"
        for name in ("Also", "Waits")
    ]


def test_what_comes_after_a_crash_is_still_tried(
    fluxvla: Fluxvla, install: Install, alone: Callable[[], None]
) -> None:
    points = "[fluxvla.operators]\nExits = acme_exits:Exits\nNeeds = acme_needs:Needs\n"
    install("acme-many", entry_points=points, files=BROKEN)
    alone()
    out = fluxvla("plugins", "doctor").out
    assert "'acme_exits' ended the interpreter (exit status 3)" in out
    assert "it needs 'acme_vendor_sdk'" in out


def test_a_syntax_error_is_told_without_an_import(fluxvla: Fluxvla, install: Install) -> None:
    """Also where the entry point's module only hands the class on."""
    install(
        "acme-typo",
        entry_points="[fluxvla.operators]\nOdd = acme_odd:Odd\nNul = acme_nul:Nul\n"
        "Handed = acme_top:Handed\n",
        files={
            "acme_odd.py": "import os\nclass Odd\n",
            "acme_nul.py": "class Nul: ...\0\n",
            "acme_top/__init__.py": "from acme_top.robot import Handed\n",
            "acme_top/robot.py": "class Handed:\n    pass\n  x = 1\n",
        },
    )
    out = fluxvla("plugins", "doctor", "--no-import").out
    said = "acme-typo 1.0 provides '{}' but its source has a syntax error: {}"
    assert said.format("Odd", "acme_odd.py:2: expected ':'") in out
    assert said.format("Handed", "acme_top/robot.py:3: unindent does not match") in out
    assert said.format("Nul", "acme_nul.py:1: source code ") in out
    assert "cannot work  acme-typo 1.0 provides 'Odd'" in fluxvla("plugins", "show", "Odd").out


def test_what_a_module_defines_is_not_said_to_be_missing(
    fluxvla: Fluxvla, install: Install, alone: Callable[[], None]
) -> None:
    source = """
from contextlib import suppress
class _Made: ...
First = Second = _Made
Third, (Fourth, *_) = _Made, (_Made,)
with suppress(ImportError):
    Fifth = _Made
for _ in range(1):
    table = {}
    class Sixth: ...
table["Gone"] = table
"""
    names = ("First", "Second", "Third", "Fourth", "Fifth", "Sixth", "Gone")
    points = "".join(f"{name} = acme_made:{name}\n" for name in names)
    install("acme-made", entry_points=f"[fluxvla.heads]\n{points}", files={"acme_made.py": source})
    alone()
    (line,) = fluxvla("plugins", "doctor", "--no-import").out.splitlines()
    assert "entry point Gone = 'acme_made:Gone' names an object that does not exist" in line
