"""``fluxvla plugins doctor``."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fluxvla_core.cli import machine
from fluxvla_core.plugins import _metadata
from tests.conftest import Install

from .conftest import Fluxvla

HERE: dict[str, Any] = machine.facts(None, {})


@pytest.fixture(autouse=True)
def _another_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """To import torch for each test would take long; test_doctor_machine.py looks at this one."""
    monkeypatch.setattr(machine, "facts", lambda limit: HERE)
    monkeypatch.setattr(machine, "remarks", lambda facts: ())
    monkeypatch.setattr(machine, "lines", lambda facts: [])


def told(out: str) -> list[str]:
    """The findings in the output."""
    return out.partition("machine\n")[0].splitlines()


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
        "write type='acme-arm:Arm' or type='other-arm:Arm' to choose, or uninstall one",
        "acme-odd 1.0: Odd is in 'fluxvla.operator', which nothing reads; "
        "did its author mean 'fluxvla.operators'?",
        "acme-odd 1.0: Odder is in 'fluxvla.zzz', which nothing reads",
        "note: acme-odd 1.0: the command 'run' is the core's own; this one is run as fluxvla "
        "acme-odd:run",
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
        monkeypatch.setattr("fluxvla_core.cli.doctor.index", lambda: index)

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
    assert (ended.code, ended.out) == (
        0,
        "no problems: 2 plugin(s) of 2 distribution(s)\nmachine\n",
    )
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
    assert sorted(told(ended.out)) == [
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
    assert sorted(told(ended.out)) == [
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
    (line,) = told(fluxvla("plugins", "doctor", "--no-import").out)
    assert "entry point Gone = 'acme_made:Gone' names an object that does not exist" in line


def test_an_installation_older_than_its_entry_points_is_told(
    fluxvla: Fluxvla, install: Install, tmp_path: Path
) -> None:
    info = install("acme-desk", entry_points=entry("Desk", "desk"), files={"desk.py": DESK})
    about = {"url": tmp_path.as_uri(), "dir_info": {"editable": True}}
    (info / "direct_url.json").write_text(json.dumps(about))
    points = '[project.entry-points."fluxvla.operators"]\nDesk = "desk:Desk"\nLamp = "desk:Lamp"'
    (tmp_path / "pyproject.toml").write_text(f'[project]\nname = "acme-desk"\n{points}\n')
    ended = fluxvla("plugins", "doctor", "--no-import", "--json")
    found = [f for f in json.loads(ended.out)["findings"] if f["distribution"] == "acme-desk"]
    text = "acme-desk 1.0: pyproject.toml changed since it was installed (+Lamp); run: "
    text += f"pip install -e {tmp_path}"
    told = {"kind": "stale", "problem": True, "distribution": "acme-desk", "text": text}
    assert (ended.code, found) == (1, [told])


def test_a_dependency_that_is_missing_is_named_though_nothing_imported_it(
    fluxvla: Fluxvla, install: Install, alone: Callable[[], None]
) -> None:
    lazy = "class Desk:\n    def get_frame(self): import acme_serial_module\n"
    requires = (
        "acme-pyserial>=3",
        "numpy>=99",
        "numpy>=1",
        "acme-windows; sys_platform == 'none'",
        "acme-fast; extra == 'fast'",
        "acme-kit[driver]",
    )
    install(
        "acme-desk", entry_points=entry("Desk", "desk"), files={"desk.py": lazy}, requires=requires
    )
    install(
        "acme-kit",
        requires=("acme-usb; extra == 'driver'", "acme-kit[deep]; extra == 'driver'")
        + ("acme-hid>=2; extra == 'deep'", "acme-other; extra == 'other'", "acme-base"),
    )
    alone()
    ended = fluxvla("plugins", "doctor", "--no-import")
    assert ended.code == 1
    have = _metadata.version("numpy")
    says = "acme-desk 1.0 requires"
    through = f"{says} acme-kit[driver], and that requires"
    assert told(ended.out) == [
        f"{says} acme-pyserial>=3, which is not installed: pip install 'acme-pyserial>=3'",
        f"{says} numpy>=99, but numpy {have} is installed",
        f"{through} acme-usb, which is not installed: pip install 'acme-usb'",
        f"{through} acme-kit[deep], and that requires acme-hid>=2, which is not installed: "
        "pip install 'acme-hid>=2'",
    ]


@pytest.mark.parametrize(
    "group",
    [
        *("fluxvla-operators", "fluxvla_operators", "fluxvla.operator", "FluxVLA.Operators"),
        *("fluxvla-operator", "fluxvla operators", "fluxvlaoperators", "fluxlva.operators"),
    ],
)
def test_a_misspelt_group_of_any_form(fluxvla: Fluxvla, install: Install, group: str) -> None:
    points = f"[{group}]\nMisspelt = desk:Desk\n"
    install("acme-desk", entry_points=points, files={"desk.py": DESK})
    said = f"acme-desk 1.0: Misspelt is in {group!r}, which nothing reads; "
    said += "did its author mean 'fluxvla.operators'?"
    ended = fluxvla("plugins", "doctor", "--no-import")
    assert said in told(ended.out)
    assert ended.code == 1


def test_a_group_that_names_no_registry(fluxvla: Fluxvla, install: Install) -> None:
    points = "[fluxvla]\nMisspelt = desk:Desk\n"
    install("acme-desk", entry_points=points, files={"desk.py": DESK})
    out = fluxvla("plugins", "doctor", "--no-import").out
    assert "acme-desk 1.0: Misspelt is in 'fluxvla', which nothing reads" in told(out)


def test_groups_of_others_are_theirs(install: Install) -> None:
    points = "".join(
        f"[{group}]\nX = x:X\n"
        for group in ("fluxvla_webui.widgets", "influx.runners", "console_scripts", "vla_bench")
    )
    install("acme-desk", entry_points=points)
    assert "acme-desk" in _metadata.index().folders
    assert "acme-desk" not in _metadata.index().versions


def test_an_entry_point_file_that_is_a_folder(fluxvla: Fluxvla, install: Install) -> None:
    info = install("acme-desk", entry_points=entry("Desk", "desk"))
    (info / "entry_points.txt").unlink()
    (info / "entry_points.txt").mkdir()
    _metadata.index.cache_clear()
    ended = fluxvla("plugins", "doctor", "--no-import")
    assert f"cannot be read: {info}: ValueError: entry_points.txt is not a regular file" in told(
        ended.out
    )
    assert ended.code == 1


@pytest.mark.parametrize("name", ["entry_points.txt", "METADATA"])
def test_files_that_may_not_be_read(
    fluxvla: Fluxvla, install: Install, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    info = install("acme-desk", entry_points=entry("Desk", "desk"))
    really_open = os.open

    def refuse(path: Any, *rest: Any, **named: Any) -> int:
        if str(path) == str(info / name):
            raise PermissionError(13, "Permission denied", str(path))
        return really_open(path, *rest, **named)

    monkeypatch.setattr(os, "open", refuse)
    _metadata.index.cache_clear()
    (line,) = [t for t in told(fluxvla("plugins", "doctor", "--no-import").out) if str(info) in t]
    assert line.startswith(f"cannot be read: {info}: PermissionError: ")


def test_links_that_lead_in_a_circle(fluxvla: Fluxvla, install: Install) -> None:
    info = install("acme-desk", entry_points=entry("Desk", "desk"))
    (info / "METADATA").unlink()
    (info / "METADATA").symlink_to("METADATA")
    _metadata.index.cache_clear()
    (line,) = [t for t in told(fluxvla("plugins", "doctor", "--no-import").out) if str(info) in t]
    assert "Too many levels of symbolic links" in line


def test_what_the_core_provides_too_is_a_note(
    fluxvla: Fluxvla, install: Install, alone: Callable[[], None]
) -> None:
    points = "[fluxvla.transforms]\nResizeImages = desk:Resize\n"
    files = {"desk.py": "class Resize:\n    def __call__(self, sample): ...\n"}
    install("acme-desk", entry_points=points, files=files)
    ended = fluxvla("plugins", "doctor", "--no-import")
    assert (
        "note: fluxvla.transforms: 'ResizeImages' always means the core's; acme-desk 1.0 has one, "
        "too, which a config names 'acme-desk:ResizeImages'"
    ) in told(ended.out)
    assert ended.code == 0


def test_a_type_in_a_misspelt_group_is_told_where_a_config_names_it(
    fluxvla: Fluxvla, install: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    points = "[fluxvla-operators]\nDesk = desk:Desk\n"
    install("acme-desk", entry_points=points, files={"desk.py": DESK})
    unread = "acme-desk 1.0: Desk is in 'fluxvla-operators', which nothing reads; did its author "
    unread += "mean 'fluxvla.operators'?"
    Path("c.py").write_text("x = dict(operator=dict(type='Desk'))\nrobot = dict(type='Desk')\n")
    ended = fluxvla("config", "check", "c.py")
    assert ended.code == 2
    said = "x.operator.type: no fluxvla.operators plugin named 'Desk'"
    assert f"c.py:1: {said}; {unread}" in ended.err
    assert f"c.py:2: robot.type: no plugin named 'Desk' in any registry; {unread}" in ended.err


def test_doctor_for_machines(fluxvla: Fluxvla, install: Install, alone: Callable[[], None]) -> None:
    install("acme-needs", entry_points=entry("Needs", "acme_needs"), files=BROKEN)
    alone()
    ended = fluxvla("plugins", "doctor", "--json")
    report = json.loads(ended.out)
    assert ended.code == 1
    assert {k: v for k, v in report.items() if k not in ("findings", "machine")} == {
        "format": "fluxvla-doctor-1",
        "healthy": False,
        "imported": True,
        "plugins": 1,
        "distributions": 1,
    }
    (found,) = report["findings"]
    assert (found["kind"], found["problem"], found["distribution"]) == (
        "import",
        True,
        "acme-needs",
    )
    assert "it needs 'acme_vendor_sdk', which is not installed" in found["text"]
    assert set(report["machine"]) == set(HERE)
