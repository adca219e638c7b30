"""Golden files: what other implementations computed, and whether they would compute it again.

A program ``plugins/fluxvla-NAME/tests/oracles/make_REFERENCE.py``

- says at top level which environment it runs in: ``ENVIRONMENT = "lerobot061"``, one of
  ``tools.oracle_env.ENVIRONMENTS``; without that line it is run by hand, and its docstring says
  where and how;
- is run from the repository's root, which is on ``PYTHONPATH``, with one thread and off the net,
  as ``python PROGRAM [FOLDER]``; FOLDER is ``plugins/fluxvla-NAME/tests/golden`` if it is left out;
- writes ``FOLDER/**/*.safetensors`` with the versions of what it compares with in the metadata;
- takes weights and inputs from ``tests.oracles.fill``, and nothing from a clock or an unseeded
  generator, so that it writes the same again; names of what is computed in bfloat16 begin with
  ``bf16.``.

Every file in a ``tests/golden`` is written by one of the programs beside it.

    python -m tools.golden FOLDER COMMITTED [--some]
                                    compares; needs numpy and safetensors. With --some not every
                                    committed file has to be in FOLDER.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tools import project

TOLERANCE = 1e-5
"""Of a tensor's largest magnitude: processors differ in the order of sums."""
NARROW, NARROW_TOLERANCE = "bf16.", 5e-2
"""Names of what was computed in bfloat16 begin so, and are compared with this."""
_ENVIRONMENT = re.compile(r"^ENVIRONMENT = \"(\w+)\"$", re.MULTILINE)


@dataclass(frozen=True)
class Program:
    """A program that writes golden files, and the environment it runs in; None: by hand."""

    path: Path
    environment: str | None

    @property
    def golden(self) -> Path:
        """The folder of the committed files."""
        return self.path.parent.parent / "golden"


def programs(root: Path = project.ROOT) -> list[Program]:
    """All programs of the repository, in a fixed order."""
    found = []
    for path in sorted(root.glob("plugins/*/tests/oracles/make_*.py")):
        named = _ENVIRONMENT.search(path.read_text(encoding="utf-8"))
        found.append(Program(path, named and named[1]))
    return found


def differences(made: Path, committed: Path, some: bool = False) -> list[str]:
    """What differs between two folders of golden files, a line each; empty if they agree.

    With ``some``, ``committed`` may have files besides.
    """
    names = {
        folder: {p.relative_to(folder).as_posix() for p in folder.rglob("*.safetensors")}
        for folder in (made, committed)
    }
    gone = () if some else sorted(names[committed] - names[made])
    lines = [f"{name}: no program wrote it" for name in gone]
    lines += [f"{name}: not in {committed}" for name in sorted(names[made] - names[committed])]
    for name in sorted(names[made] & names[committed]):
        found = compared(_tensors(made / name), _tensors(committed / name))
        lines += [f"{name}: {line}" for line in found]
    return lines


def compared(made: Mapping[str, Any], committed: Mapping[str, Any]) -> list[str]:
    """What differs between two files' arrays, a line each."""
    lines = [f"{name}: only in one of them" for name in sorted(set(made) ^ set(committed))]
    for name in sorted(set(made) & set(committed)):
        ours, theirs = made[name], committed[name]
        if ours.shape != theirs.shape or ours.dtype != theirs.dtype:
            both = f"{ours.dtype} {ours.shape}, committed {theirs.dtype} {theirs.shape}"
            lines.append(f"{name}: {both}")
            continue
        apart = float(abs(ours.astype("float64") - theirs.astype("float64")).max(initial=0.0))
        largest = float(abs(theirs.astype("float64")).max(initial=0.0))
        share = NARROW_TOLERANCE if name.startswith(NARROW) else TOLERANCE
        bound = share * largest if theirs.dtype.kind == "f" else 0.0
        if not apart <= bound:
            lines.append(f"{name}: {apart:.3g} apart, at most {bound:.3g} expected")
    return lines


def _tensors(path: Path) -> Mapping[str, Any]:
    from safetensors.numpy import load_file

    return load_file(path)


def main() -> int:
    words = [word for word in sys.argv[1:] if word != "--some"]
    made, committed = map(Path, words)
    lines = differences(made, committed, some="--some" in sys.argv)
    print(*lines, sep="\n", end="\n" if lines else "")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
