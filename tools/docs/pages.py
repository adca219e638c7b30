"""Which files of the repository are pages of the site, and the links between them.

Pages are written to be read on GitHub as well, so their links lead to files of the repository. Some
of those lie outside ``docs``: READMEs of plugins become pages, a module of contracts leads to the
reference that is generated from it, and any other file becomes a page that shows its text.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

DOCS = "docs"
IMAGE_SUFFIXES = {".jpg", ".png", ".svg"}
_FIXED = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
_CONTRACTS = "src/fluxvla_core/contracts"
_REFERENCE = {
    f"{_CONTRACTS}/robot.py": "reference/operator.md",
    f"{_CONTRACTS}/frame.py": "reference/records.md",
    "src/fluxvla_core/spec.py": "reference/records.md",
    f"{_CONTRACTS}/policy.py": "reference/policy.md",
    f"{_CONTRACTS}/environment.py": "reference/environment.md",
    f"{_CONTRACTS}/training.py": "reference/training.md",
    f"{_CONTRACTS}/runner.py": "reference/runner.md",
    f"{_CONTRACTS}/checkpoint_format.py": "reference/checkpoint-format.md",
    "src/fluxvla_core/registries.py": "reference/registries.md",
    "src/fluxvla_core/cli/main.py": "reference/commands.md",
}
"""Modules that a page of the reference is generated from."""
_LANGUAGES = {".py": "python", ".toml": "toml", ".json": "json", ".xml": "xml", ".yml": "yaml"}
_MARKED = re.compile(r"^<!-- (\w+): (.+?) -->\n```(\w*)\n", re.MULTILINE)
_CODE = re.compile(r"(?P<code>(`+)[^`].*?\2)|<", re.S)
# Code in which brackets are no links, or the target of a link.
_LINK = re.compile(r"(?P<code>^```.*?^```|`[^`\n]+`)|\]\((?P<target>[^)\s]+)\)", re.M | re.S)


def pages(root: Path) -> dict[str, str]:
    """Path of a file in the repository -> path of its page, relative to the site's source."""
    found = {**_FIXED, **_REFERENCE}
    for path in sorted((root / DOCS).rglob("*.md")):
        name = path.relative_to(root / DOCS).as_posix()
        found[f"{DOCS}/{name}"] = name
    for folder in ("plugins", "examples"):
        for path in sorted((root / folder).glob("*/README.md")):
            found[f"{folder}/{path.parent.name}/README.md"] = f"{folder}/{path.parent.name}.md"
    return found


def copied(root: Path) -> dict[str, str]:
    """Those of ``pages`` whose text is a file outside ``docs``."""
    return {
        path: page
        for path, page in pages(root).items()
        if path.endswith(".md") and not path.startswith(f"{DOCS}/") and path != "README.md"
    }


def targets(text: str) -> Iterator[str]:
    """The targets of the links in ``text``."""
    for found in _LINK.finditer(text):
        if found["target"]:
            yield found["target"]


def linked_files(root: Path) -> dict[str, str]:
    """Other files that pages link to -> the pages that show them; of images the image."""
    known = pages(root)
    found: dict[str, str] = {}
    for path in [p for p in known if p.endswith(".md")]:
        for target in targets((root / path).read_text(encoding="utf-8")):
            there = resolved(path, target.partition("#")[0])
            if "://" in target or not there or there in known:
                continue
            if (root / there).is_file() and not there.startswith(f"{DOCS}/"):
                shown = there if Path(there).suffix in IMAGE_SUFFIXES else f"{there}.md"
                found[there] = f"sources/{shown}"
    return found


def shown(path: str, text: str) -> str:
    """The page that shows the file ``path``."""
    language = _LANGUAGES.get(Path(path).suffix, "text")
    return f"# {path}\n\n````{language}\n{text.rstrip()}\n````\n"


def escaped(text: str) -> str:
    """``text`` as Markdown: ``<>`` outside of code is escaped."""
    return _CODE.sub(lambda found: found["code"] or found[0].replace("<", "&lt;"), text)


def resolved(path: str, target: str) -> str:
    """The file that ``target``, a link in the file ``path``, leads to; "" for the file itself."""
    return os.path.normpath(os.path.join(os.path.dirname(path), target)) if target else ""


def relinked(text: str, path: str, known: Mapping[str, str]) -> str:
    """``text`` of the file ``path`` with links between pages instead of files.

    Args:
        known: file -> page, of all pages.
    """
    here = os.path.dirname(known[path])

    def link(found: re.Match[str]) -> str:
        target = found["target"]
        if not target or "://" in target or target.startswith("#"):
            return found[0]
        file, mark, anchor = target.partition("#")
        page = known.get(resolved(path, file))
        if page is None:
            return found[0]
        return f"]({os.path.relpath(page, here or '.')}{mark}{anchor})"

    return _LINK.sub(link, text)


def titled(text: str) -> str:
    """``text`` with the names of files as titles of their blocks, without notes for the tests."""

    def fence(found: re.Match[str]) -> str:
        title = f' title="{found[2]}"' if found[1] == "file" else ""
        return f"```{found[3]}{title}\n"

    return _MARKED.sub(fence, text)
