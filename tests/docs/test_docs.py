"""Every command and file in README and docs is run, page by page, as a reader would.

Blocks of one page run in order in one folder, which has the repository's ``configs`` in it. A
comment before a block says what becomes of it: ``<!-- file: NAME -->`` writes it to a file,
``<!-- not run: WHY -->`` leaves it out.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tools import rendering, shell
from tools.envs import Env

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "plugins").glob("*/README.md")),
    *sorted((ROOT / "examples").glob("*.md")),
]
BLOCK = re.compile(
    r"^(?:<!-- (?P<marker>file|not run): (?P<text>.+?) -->\n)?```(?P<language>\w*)\n"
    r"(?P<body>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
RUN = {"bash", "sh", "console"}


@dataclass(frozen=True)
class Block:
    marker: str
    text: str
    language: str
    body: str


def blocks(text: str) -> Iterator[Block]:
    for found in BLOCK.finditer(text):
        yield Block(*(found[name] or "" for name in ("marker", "text", "language", "body")))


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> Env:
    """An environment on top of this one: what a page installs is seen there and nowhere else."""
    env = Env(tmp_path_factory.mktemp("docs") / "env")
    env.create()
    code = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(env.run("python", "-c", code, quiet=True, echo=False).strip())
    below = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    line = f"import site; site.addsitedir({below.stdout.strip()!r})\n"
    (site / "below.pth").write_text(line)
    program = env.bin / "fluxvla"
    program.write_text(
        f"#!{env.python}\nimport sys\nfrom fluxvla_core.cli.main import main\n"
        "if __name__ == '__main__':\n    sys.exit(main())\n"
    )
    program.chmod(0o755)
    return env


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_what_a_page_tells_to_do_works(page: Path, env: Env, tmp_path: Path) -> None:
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    for block in blocks(page.read_text(encoding="utf-8")):
        if block.marker == "not run":
            continue
        if block.marker == "file":
            target = tmp_path / block.text
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(block.body, encoding="utf-8")
        elif block.language in RUN:
            script = f"set -euo pipefail\n{block.body}"
            variables = {**env.variables(), **rendering.VARIABLES, "OMP_NUM_THREADS": "1"}
            command = ["bash", "-c", script]
            shell.run(command, cwd=tmp_path, env=variables, quiet=True, echo=False)
        elif block.language == "python":
            env.run("python", "-c", block.body, cwd=tmp_path, quiet=True, echo=False)


def test_every_block_says_what_it_is() -> None:
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        found = list(blocks(text))
        fences = len(re.findall(r"^```", text, re.MULTILINE))
        assert fences == 2 * len(found), f"{page.name}: a fence is not closed"
        unnamed = [b.body[:40] for b in found if not b.language]
        assert unnamed == [], f"{page.name}: blocks without a language"


def test_links_to_files_of_the_repository_lead_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_the_blocks_of_a_page_are_found() -> None:
    text = (
        "a\n<!-- file: x.py -->\n```python\nx = 1\n```\n\n<!-- not run: no -->\n```bash\nrm\n```\n"
    )
    assert list(blocks(text)) == [
        Block("file", "x.py", "python", "x = 1\n"),
        Block("not run", "no", "bash", "rm\n"),
    ]
