"""mkdocs' hook: adds the pages that are no files of ``docs``, and makes links lead to pages.

``mkdocs.yml`` names it. What it generates is written nowhere but into the site.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files, InclusionLevel

ROOT = Path(__file__).resolve().parents[2]


def find_sources() -> None:
    """Make the core importable, and the imports of plugins' commands, without installing them."""
    for folder in (ROOT, ROOT / "src", *sorted((ROOT / "plugins").glob("*/src"))):
        if str(folder) not in sys.path:
            sys.path.append(str(folder))


find_sources()

from tools.docs import classes, commands, contracts, pages  # noqa: E402


@functools.cache
def generated() -> list[tuple[str, str]]:
    """Path and text of every page that is generated."""
    return list(_generated())


def _generated() -> Iterator[tuple[str, str]]:
    find_sources()  # mkdocs has put back what it was before the hook was read
    for page in contracts.PAGES:
        yield f"reference/{page.name}.md", contracts.render(page, ROOT / "src" / "fluxvla_core")
    yield "reference/registries.md", classes.render_registries(ROOT)
    yield "reference/commands.md", commands.render(ROOT)
    for row in classes.listed(ROOT):
        yield classes.page_of(row), classes.render_classes(ROOT, row)
    for path, page in pages.linked_files(ROOT).items():
        if page.endswith(".md"):
            yield page, pages.shown(path, (ROOT / path).read_text(encoding="utf-8"))


def expanded(nav: list[Any], known: list[str]) -> list[Any]:
    """``nav`` with ``FOLDER/*`` replaced by the pages of that folder."""
    found: list[Any] = []
    for item in nav:
        if isinstance(item, str) and item.endswith("/*"):
            found += sorted(page for page in known if page.rpartition("/")[0] == item[:-2])
        elif isinstance(item, dict):
            found.append(
                {k: expanded(v, known) if isinstance(v, list) else v for k, v in item.items()}
            )
        else:
            found.append(item)
    return found


def on_config(config: Any) -> Any:
    """Fill in the parts of the navigation that list files of the repository."""
    known = [page for page, _ in generated()] + list(pages.pages(ROOT).values())
    config.nav = expanded(config.nav, known)
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add generated pages, and READMEs of plugins and examples."""
    for path, page in pages.copied(ROOT).items():
        text = (ROOT / path).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=text))
    for path, page in pages.linked_files(ROOT).items():
        if not page.endswith(".md"):
            files.append(File.generated(config, page, content=(ROOT / path).read_bytes()))
    for page, text in generated():
        file = File.generated(config, page, content=text)
        if page.startswith("sources/"):
            file.inclusion = InclusionLevel.NOT_IN_NAV
        files.append(file)
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Links between pages, and the names of files as titles of blocks."""
    known = {**pages.pages(ROOT), **pages.linked_files(ROOT)}
    paths = {uri: path for path, uri in known.items() if path.endswith(".md")}
    path = paths.get(page.file.src_uri)
    if page.file.src_uri == "index.md":
        path = "docs/index.md"
    return markdown if path is None else pages.titled(pages.relinked(markdown, path, known))
