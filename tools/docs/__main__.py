"""Build the site, and check its links: ``python -m tools.docs [build [DIR] | serve]``."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tools.docs import links

ROOT = Path(__file__).resolve().parents[2]
SITE = ROOT / "site"
# Since 9.7 the theme prints an advertisement of its authors' next project.
QUIET = {"NO_MKDOCS_2_WARNING": "1"}


def build(site: Path = SITE) -> list[str]:
    """Build the site into ``site``; returns its problems.

    Raises:
        subprocess.CalledProcessError: mkdocs found something.
    """
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--clean"]
    subprocess.run([*command, "-d", str(site)], cwd=ROOT, env={**os.environ, **QUIET}, check=True)
    return links.problems(site)


def main(words: list[str]) -> int:
    """Exit code 1 if something is wrong with the site."""
    if words == ["serve"]:
        command = [sys.executable, "-m", "mkdocs", "serve", "--strict"]
        ended = subprocess.run(command, cwd=ROOT, env={**os.environ, **QUIET}, check=False)
        return ended.returncode
    if words[:1] not in ([], ["build"]) or len(words) > 2:
        print(__doc__, file=sys.stderr)
        return 2
    site = Path(words[1]) if len(words) == 2 else SITE
    try:
        found = build(site)
    except subprocess.CalledProcessError as error:
        return error.returncode
    print(*found, f"{site / 'index.html'}: {len(found)} problems with links", sep="\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
