"""One Python that imports from two environments."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tools.envs import Env, join

PYTHON = f"python{sys.version_info[0]}.{sys.version_info[1]}"


def environment(root: Path, python: str = PYTHON, **modules: str) -> Env:
    place = root / "lib" / python / "site-packages"
    place.mkdir(parents=True)
    for name, text in modules.items():
        (place / f"{name}.py").write_text(text)
    return Env(root)


def test_the_first_comes_first_and_editable_installations_of_the_second_are_seen(
    tmp_path: Path,
) -> None:
    (tmp_path / "checkout").mkdir()
    (tmp_path / "checkout" / "edited.py").write_text("NAME = 'edited'\n")
    first = environment(tmp_path / "first", both="NAME = 'first'\n")
    second = environment(tmp_path / "second", both="NAME = 'second'\n", more="NAME = 'second'\n")
    pth = tmp_path / "second" / "lib" / PYTHON / "site-packages" / "edited.pth"
    pth.write_text(f"{tmp_path / 'checkout'}\n")
    for _ in range(2):  # made again
        joined = join(first, second)
    code = "import both, more, edited; print(both.NAME, more.NAME, edited.NAME)"
    assert joined.run("python", "-c", code, quiet=True, echo=False).split() == [
        "first",
        "second",
        "edited",
    ]


def test_variables_are_those_of_the_first(tmp_path: Path) -> None:
    class Special(Env):
        def variables(self) -> dict[str, str]:
            return {**super().variables(), "SPECIAL": "1"}

    environment(tmp_path / "first")
    joined = join(Special(tmp_path / "first"), environment(tmp_path / "second"))
    found = joined.variables()
    assert found["SPECIAL"] == "1"
    assert found["VIRTUAL_ENV"] == str(joined.root)


def test_another_python_is_refused(tmp_path: Path) -> None:
    old = environment(tmp_path / "old", "python3.1")
    with pytest.raises(ValueError, match="of several Python versions"):
        join(environment(tmp_path / "first"), old)
