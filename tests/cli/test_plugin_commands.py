"""``fluxvla plugins list`` and ``show``."""

from __future__ import annotations

import json
import os
import subprocess
import sys

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
            "copies its images: code of its own that holds the GIL delays commands\n"
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


def test_show_for_machines(fluxvla: Fluxvla, arm: Install) -> None:
    (found,) = json.loads(fluxvla("plugins", "show", "Arm", "--json").out)
    assert found == {
        "group": "fluxvla.operators",
        "name": "Arm",
        "distribution": "acme-arm",
        "version": "2.1",
        "value": "acme_arm:Arm",
        "problem": None,
        "defined_at": "acme_arm.py:5",
        "contract": "1.0",
        "about": "Moves things.",
        "parameters": [
            {
                "name": "port",
                "required": True,
                "injected": False,
                "annotation": "str",
                "default": None,
                "description": None,
            },
            {
                "name": "rate",
                "required": False,
                "injected": False,
                "annotation": "int",
                "default": "30",
                "description": None,
            },
            {
                "name": "context",
                "required": False,
                "injected": True,
                "annotation": None,
                "default": "None",
                "description": None,
            },
        ],
        "takes_others": True,
    }
    assert "acme_arm" not in sys.modules


def test_show_for_machines_of_what_cannot_work(fluxvla: Fluxvla, install: Install) -> None:
    points = "[fluxvla.head]\nBare = acme_bare:Bare\n[fluxvla.heads]\nLost = acme_lost:Lost\n"
    install("acme-bare", entry_points=points, files={"acme_bare.py": "class Bare: ...\n"})
    (found,) = json.loads(fluxvla("plugins", "show", "Lost", "--json").out)
    assert "its module 'acme_lost' is missing" in found["problem"]
    assert found["parameters"] is None
    (found,) = json.loads(fluxvla("plugins", "show", "Bare", "--json").out)
    assert (
        "'fluxvla.head', which nothing reads; did its author mean 'fluxvla.heads'?"
        in (found["problem"])
    )
    assert "cannot work  acme-bare 1.0: Bare is in 'fluxvla.head', which nothing reads" in (
        fluxvla("plugins", "show", "Bare").out
    )
