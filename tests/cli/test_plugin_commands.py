"""``fluxvla plugins list``, ``show`` and ``doctor``."""

from __future__ import annotations

import json
import sys

import pytest

from fluxvla_core.plugins import _metadata
from tests.conftest import Install

from .conftest import Fluxvla

ARM = '''
from fluxvla_core.infer import nothing
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
    monkeypatch.setattr("fluxvla_core.cli.plugin_list.index", lambda: _metadata.Index({}, ()))
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
    ended = fluxvla("plugins", "doctor")
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


def test_doctor_of_a_sound_installation(
    fluxvla: Fluxvla, arm: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    every = _metadata.index()
    ours = {k: v for k, v in every.plugins.items() if v[0].dist == "acme-arm"}
    for module in ("plugin_list", "doctor"):
        monkeypatch.setattr(f"fluxvla_core.cli.{module}.index", lambda: _metadata.Index(ours, ()))
    ended = fluxvla("plugins", "doctor")
    assert (ended.code, ended.out) == (0, "no problems: 1 plugin(s) of 1 distribution(s)\n")
