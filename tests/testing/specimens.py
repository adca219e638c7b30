"""Runs a conformance kit on a right specimen and on broken ones, each in words of its own.

A specimen is a text: a class that registers itself, called ``Specimen``, and its kit's subclass.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

KIT = "# the kit\n"
"""Begins what is not installed of a specimen that is."""


@dataclass(frozen=True)
class Fault:
    """A change of the right specimen, and which checks find it.

    Args:
        check: the one that fails, without its ``test_``.
        old, new: the change.
        words: part of what it says.
        also: further checks that cannot but fail.
    """

    check: str
    old: str
    new: str
    words: str
    also: tuple[str, ...] = ()


Outcomes = Mapping[str, Mapping[str, str]]
"""Specimen -> check -> what it said: "" passed, "skipped: ..." skipped, else the failure."""


def outcomes(
    folder: Path, good: str, faults: Mapping[str, Fault], registry: str | None = None
) -> Outcomes:
    """Every check on ``good`` (as specimen ``good``) and on each of its broken forms.

    Args:
        registry: of classes that other processes have to find: they are installed then, instead of
            registering themselves. The kit's subclass is what follows ``KIT``.
    """
    sources = {"good": good}
    for name, fault in faults.items():
        assert good.count(fault.old) == 1, f"{name}: {fault.old!r} is there {good.count(fault.old)}"
        sources[name] = good.replace(fault.old, fault.new)
    for number, source in enumerate(sources.values()):
        text = source.replace("Specimen", f"Specimen{number}")
        if registry is not None:
            text, _, kit = text.partition(KIT)
            (folder / "site").mkdir(exist_ok=True)
            (folder / "site" / f"installed_{number}.py").write_text(text)
            text = kit
        (folder / f"specimen_{number}.py").write_text(text)
    words = ["-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--junitxml", "cases.xml"]
    words += ["--import-mode=importlib", *(f"specimen_{n}.py" for n in range(len(sources)))]
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    if registry is not None:
        _install(folder / "site", registry, len(sources))
        env["PYTHONPATH"] = str(folder / "site")
    run = [sys.executable, "-m", "pytest", *words]
    done = subprocess.run(run, capture_output=True, text=True, cwd=folder, env=env, timeout=1100)
    assert (folder / "cases.xml").exists(), done.stdout + done.stderr
    found: dict[str, dict[str, str]] = {name: {} for name in sources}
    names = {f"specimen_{number}": name for number, name in enumerate(sources)}
    for case in ElementTree.parse(folder / "cases.xml").iter("testcase"):
        specimen = names[str(case.get("classname")).split(".")[0]]
        check = str(case.get("name")).removeprefix("test_")
        found[specimen][check] = _said(case)
    assert all(found.values()), done.stdout
    return found


def _install(site: Path, registry: str, count: int) -> None:
    """Metadata of a distribution with the modules ``installed_0``, ``installed_1``, ... of site."""
    info = site / "specimens-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: specimens\nVersion: 1.0\n")
    lines = [f"Specimen{number} = installed_{number}:Specimen{number}" for number in range(count)]
    (info / "entry_points.txt").write_text("\n".join([f"[fluxvla.{registry}]", *lines]) + "\n")


def _said(case: ElementTree.Element) -> str:
    for part in case:
        if part.tag in ("failure", "error"):
            return str(part.get("message"))
        if part.tag == "skipped":
            return f"skipped: {part.get('message')}"
    return ""


def failed(found: Mapping[str, str]) -> set[str]:
    """The checks that failed, without their parameters."""
    wrong = {check for check, said in found.items() if said and not said.startswith("skipped")}
    return {check.partition("[")[0] for check in wrong}


def check_good(found: Outcomes, checks: int) -> None:
    """The right specimen passes at least so many checks, and fails none."""
    said = found["good"]
    assert not failed(said), {check: said[check] for check in said if said[check]}
    assert sum(not text for text in said.values()) >= checks


def check_fault(found: Outcomes, name: str, fault: Fault) -> None:
    """The broken specimen fails its own check, which says why, and no other."""
    said = found[name]
    assert failed(said) == {fault.check, *fault.also}, {c: said[c] for c in said if said[c]}
    texts = [text for check, text in said.items() if check.partition("[")[0] == fault.check]
    assert any(fault.words in " ".join(text.split()) for text in texts), texts
