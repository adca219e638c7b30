"""Read a report's page in tests: its text, its links, its unclosed tags."""

from __future__ import annotations

import html.parser
import json
from pathlib import Path

from fluxvla_report import build_report


class Page(html.parser.HTMLParser):
    """Text, sources and unclosed tags of a page."""

    VOID = frozenset({"meta", "link", "br", "img", "input"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text: list[str] = []
        self.sources: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [v or "" for k, v in attrs if k in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if data.strip() and self.open[-1:] != ["style"]:
            self.text.append(" ".join(data.split()))

    def shows(self, words: str) -> bool:
        return words in " ".join(self.text)


def page_of(work_dir: Path, tmp_path: Path) -> Page:
    page = Page(build_report(work_dir, tmp_path / "out" / "r.html").read_text(encoding="utf-8"))
    assert page.open == []
    return page


def little(folder: Path) -> Path:
    """A work dir of which there is next to nothing to show."""
    folder.mkdir(exist_ok=True)
    stages = {"stages": [{"name": "collect", "seconds": 1.0}]}
    (folder / "stages.json").write_text(json.dumps(stages))
    return folder
