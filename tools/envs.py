"""Virtual environments that are filled once and re-used until what they are made from changes.

nox keeps one environment for each session. Here several sessions share one (lint, types, layers
and tests need the same things, torch among them), so the environments are named and kept here.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from tools import shell

STAMP = "fluxvla-installed.json"


@dataclasses.dataclass(frozen=True)
class Env:
    """A virtual environment at ``root``."""

    root: Path

    @property
    def bin(self) -> Path:
        return self.root / ("Scripts" if os.name == "nt" else "bin")

    @property
    def python(self) -> Path:
        return self.bin / "python"

    def variables(self) -> dict[str, str]:
        """The variables of an activated environment."""
        path = os.pathsep.join([str(self.bin), os.environ.get("PATH", os.defpath)])
        return {"VIRTUAL_ENV": str(self.root), "PATH": path}

    def run(
        self,
        program: str,
        *words: str | os.PathLike[str],
        cwd: Path | None = None,
        env: Mapping[str, str] | None = None,
        quiet: bool = False,
        echo: bool = True,
    ) -> str:
        """``shell.run`` of one of this environment's programs, which come first on its PATH."""
        variables = {**self.variables(), **(env or {})}
        command = [self.bin / program, *words]
        return shell.run(command, cwd=cwd, env=variables, quiet=quiet, echo=echo)

    def pip_install(
        self,
        *words: str | os.PathLike[str],
        constraints: Path | None = None,
        quiet: bool = False,
    ) -> None:
        """pip install, under the constraints if there are any; raises StepFailed.

        What is imported is compiled then: most of what is installed never is.
        """
        options = ["-q", "--disable-pip-version-check", "--no-compile"]
        if constraints is not None:
            options += ["-c", str(constraints)]
        self.run("python", "-m", "pip", "install", *options, *words, quiet=quiet, echo=not quiet)

    def create(self) -> None:
        """Make it again, empty, with the Python that runs this."""
        shutil.rmtree(self.root, ignore_errors=True)
        shell.run([sys.executable, "-m", "virtualenv", "-q", self.root])

    def stamp(self) -> dict[str, str]:
        """What was installed by ``filled``; empty when nothing was, or the stamp is damaged."""
        try:
            content = json.loads((self.root / STAMP).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return content if isinstance(content, dict) else {}

    def filled(
        self,
        base: Mapping[str, str],
        parts: Mapping[str, str],
        install_base: Callable[[], None],
        install_parts: Callable[[list[str], bool], None],
    ) -> bool:
        """Bring the environment to a described state; return whether anything had to be done.

        ``base`` describes what makes everything be installed from nothing (Python, constraints,
        lists of requirements); ``parts`` maps each part to a fingerprint. A changed base means a
        new environment. ``install_parts(changed, fresh)`` gets the parts to bring up to date. The
        stamp names only what is done: an interrupted installation goes on where it was.
        """
        old = self.stamp()
        key = hashlib.sha256(json.dumps(dict(base), sort_keys=True).encode()).hexdigest()
        fresh = old.get("base") != key or not self.python.exists()
        gone = {name for name in old if name != "base"} - set(parts)
        if gone and not fresh:
            fresh = True  # a part that left the repository must leave the environment, too
        changed = [name for name, print_ in parts.items() if fresh or old.get(name) != print_]
        if not changed and not fresh:
            return False
        if fresh:
            if self.root.is_symlink():  # another checkout's, which is not to be emptied
                self.root.unlink()
            self.create()
            install_base()
        unchanged = {name: text for name, text in parts.items() if name not in changed}
        self._write_stamp({"base": key, **unchanged})
        install_parts(changed, fresh)
        self._write_stamp({"base": key, **parts})
        return True

    def _write_stamp(self, record: Mapping[str, str]) -> None:
        (self.root / STAMP).write_text(json.dumps(dict(record), indent=1), encoding="utf-8")


class JoinedEnv(Env):
    """The environment at ``root``, with the variables of the first of two environments."""

    def __init__(self, root: Path, first: Env) -> None:
        super().__init__(root)
        object.__setattr__(self, "_given", first.variables())

    def variables(self) -> dict[str, str]:
        given: Mapping[str, str] = vars(self)["_given"]
        return {**given, **super().variables()}


def join(first: Env, second: Env, name: str = "joined") -> Env:
    """A Python that imports from ``first``, and packages that are missing there from ``second``.

    For LeRobot and this project, which pip would not install together: LeRobot needs an older torch
    and PyAV than ``constraints.txt`` has. Nothing is installed or copied. The environment is a
    folder of ``first``, and is created again on each call.

    Args:
        first, second: environments of the Python version that runs this.

    Raises:
        StepFailed: it cannot be made.
        ValueError: one of them is of another Python version.
    """
    root = first.root / name
    shutil.rmtree(root, ignore_errors=True)
    shell.run([sys.executable, "-m", "venv", "--without-pip", root], quiet=True, echo=False)
    own = _packages(root)
    places = [_packages(env.root) for env in (first, second)]
    if {place.parent.name for place in places} != {own.parent.name}:
        raise ValueError(f"of several Python versions: {', '.join(map(str, (own, *places)))}")
    # Not as lines of their own: then their .pth files, editable installations, would not be read.
    lines = [f"import site; site.addsitedir({str(place)!r})" for place in places]
    (own / "joined.pth").write_text("\n".join([*lines, ""]), encoding="utf-8")
    return JoinedEnv(root, first)


def _packages(root: Path) -> Path:
    (found,) = root.glob("lib/python*/site-packages")
    return found
