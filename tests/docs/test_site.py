"""The site is built without a warning, has no dead link, and fetches nothing from elsewhere."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tools.docs import links, pages

ROOT = Path(__file__).parents[2]


def test_links_between_files_become_links_between_pages() -> None:
    known = {"docs/a/b.md": "a/b.md", "plugins/x/README.md": "plugins/x.md", "docs/c.md": "c.md"}
    text = "[x](../../plugins/x/README.md#how) [c](../c.md) [web](https://e.org) `[0](../c.md)`"
    assert pages.relinked(text, "docs/a/b.md", known) == (
        "[x](../plugins/x.md#how) [c](../c.md) [web](https://e.org) `[0](../c.md)`"
    )
    assert pages.relinked("[c](../../docs/c.md)", "plugins/x/README.md", known) == "[c](../c.md)"


def test_names_of_files_are_titles_of_their_blocks() -> None:
    text = "<!-- file: a.py -->\n```python\nx\n```\n<!-- demo: why -->\n```bash\ny\n```\n"
    assert pages.titled(text) == '```python title="a.py"\nx\n```\n```bash\ny\n```\n'


def test_what_is_in_angle_brackets_is_no_html() -> None:
    assert pages.escaped("work_dirs/<name> `a<b` ``c<d``") == "work_dirs/&lt;name> `a<b` ``c<d``"


def test_every_file_that_a_page_links_to_is_shown() -> None:
    known = {**pages.pages(ROOT), **pages.linked_files(ROOT)}
    for path in pages.pages(ROOT):
        if path.endswith(".md"):
            for target in pages.targets((ROOT / path).read_text(encoding="utf-8")):
                file = target.partition("#")[0]
                there = pages.resolved(path, file)
                if "://" not in target and file and not (ROOT / there).is_dir():
                    image = there.startswith("docs/") and not there.endswith(".md")
                    assert there in known or image, f"{path} links to {target}"


@pytest.mark.parametrize(
    ("body", "found"),
    [
        ('<a href="b.html">b</a>', []),
        ('<a href="b.html#there">b</a><a href="#here" id="here">a</a>', []),
        ('<a href="https://example.org/">e</a><img src="data:image/png;base64,AA">', []),
        ('<a href="c.html">c</a>', ["a.html: the link c.html is dead"]),
        ('<a href="b.html#gone">b</a>', ["a.html: the link b.html#gone is dead"]),
        ('<a href="#gone">a</a>', ["a.html: the link #gone is dead"]),
        ('<a href="../out.html">o</a>', ["a.html: the link ../out.html is dead"]),
        ('<img src="x.png">', ["a.html: x.png is missing"]),
        (
            '<link rel="stylesheet" href="https://fonts.example.org/x.css">',
            ["a.html: https://fonts.example.org/x.css would be fetched from elsewhere"],
        ),
        (
            '<script src="//cdn.example.org/x.js"></script>',
            ["a.html: //cdn.example.org/x.js would be fetched from elsewhere"],
        ),
    ],
)
def test_what_is_wrong_with_a_page_is_said(tmp_path: Path, body: str, found: list[str]) -> None:
    site = tmp_path / "site"
    site.mkdir()
    (tmp_path / "out.html").write_text("")
    (site / "a.html").write_text(f"<html><body>{body}</body></html>")
    (site / "b.html").write_text('<html><body><h2 id="there">b</h2></body></html>')
    assert links.problems(site) == found


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if importlib.util.find_spec("material") is None:
        pytest.skip("mkdocs-material is not installed; nox -s docs builds the site")
    place = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "tools.docs", "build", str(place)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return place


def test_the_site_is_built_without_a_warning_or_a_dead_link(site: Path) -> None:
    assert links.problems(site) == []
    named = {page.replace(".md", ".html") for page in pages.pages(ROOT).values()}
    there = {path.relative_to(site).as_posix() for path in site.rglob("*.html")}
    assert named <= there


def test_styles_fetch_nothing_from_elsewhere(site: Path) -> None:
    for path in site.rglob("*.css"):
        text = path.read_text(encoding="utf-8")
        assert re.findall(r"(?:url\(|@import)\s*[\"']?(?:https?:)?//", text) == [], path.name


def test_no_page_says_what_is_for_the_tests_only(site: Path) -> None:
    for path in site.rglob("*.html"):
        assert not re.search(r"<!-- (file|fragment|nightly|demo): ", path.read_text()), path.name
