"""LeRobot and this project in one Python, from two environments that exist.

pip would not install both into one: LeRobot wants an older torch than ``constraints.txt`` has, and
an older PyAV. Here LeRobot's packages come first, in its own versions; what it has not got
(MuJoCo, pytest, this project) comes from the other environment. Nothing is installed or copied.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping
from pathlib import Path

from tools import shell
from tools.envs import Env


class JoinedEnv(Env):
    """The environment at ``root``, with the variables of LeRobot's."""

    def __init__(self, root: Path, first: Env) -> None:
        super().__init__(root)
        object.__setattr__(self, "_given", first.variables())

    def variables(self) -> dict[str, str]:
        given: Mapping[str, str] = vars(self)["_given"]
        return {**given, **super().variables()}


def join(first: Env, second: Env, name: str = "joined") -> Env:
    """A Python that imports from ``first``, and what is not there from ``second``.

    Made anew in a moment, inside of ``first``, which wipes it whenever it is made anew itself.

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
