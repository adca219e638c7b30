"""The check of a built site: no dead link, and nothing that would be fetched from elsewhere."""

from __future__ import annotations

from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

_LOADED = {"img": "src", "script": "src", "iframe": "src", "source": "src", "link": "href"}
"""Elements that a browser loads by itself -> the attribute that says what."""
_NOT_LOADED = {"canonical", "next", "prev", "alternate"}
"""Values of ``rel`` of a ``link`` that is only an address."""


@dataclass
class Html(HTMLParser):
    """Anchors, links and loaded resources of one page."""

    anchors: set[str] = field(default_factory=set)
    links: list[str] = field(default_factory=list)
    loaded: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {"rel": "", **{name: value or "" for name, value in attrs}}
        self.anchors |= {values[name] for name in ("id", "name") if values.get(name)}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        elif values.get(_LOADED.get(tag, "")) and not _NOT_LOADED & set(values["rel"].split()):
            self.loaded.append(values[_LOADED[tag]])


def read(path: Path) -> Html:
    """The page at ``path``."""
    page = Html()
    page.feed(path.read_text(encoding="utf-8"))
    return page


def problems(site: Path) -> list[str]:
    """Dead links, and what would be fetched from elsewhere, in the pages below ``site``.

    Links to other sites are not followed: they are none of this site's, and need a network.
    """
    pages = {path: read(path) for path in sorted(site.rglob("*.html"))}
    found = []
    for path, page in pages.items():
        name = path.relative_to(site).as_posix()
        for link in page.links:
            if not urlsplit(link).scheme and not _leads(site, path, link, pages):
                found.append(f"{name}: the link {link} is dead")
        for link in page.loaded:
            parts = urlsplit(link)
            if parts.scheme == "data":
                continue
            if parts.scheme or parts.netloc:
                found.append(f"{name}: {link} would be fetched from elsewhere")
            elif not _leads(site, path, link, pages):
                found.append(f"{name}: {link} is missing")
    return found


def _leads(site: Path, page: Path, link: str, pages: dict[Path, Html]) -> bool:
    parts = urlsplit(link)
    place = unquote(parts.path)
    base = site if place.startswith("/") else page.parent
    target = (base / place.lstrip("/")).resolve() if place else page
    if target.is_dir():
        target = target / "index.html"
    if not target.is_file() or not target.is_relative_to(site.resolve()):
        return False
    anchor = unquote(parts.fragment)
    # An empty one is the top of the page.
    return not anchor or target not in pages or anchor in pages[target].anchors
