"""Where each key of a ``.toml`` config is written.

A recursive-descent walk over text that ``tomli`` has accepted already: it only has to know where
keys start and where values end (TOML 1.0, https://toml.io/en/v1.0.0).
"""

from __future__ import annotations

import re

import tomli

from fluxvla_core.config import keys

_BLANK = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_SPACE = re.compile(r"[ \t]*")
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_SCALAR = re.compile(r"[^,\]\}\n#]+")
_STRINGS = (
    re.compile(r'"""(?:\\.|[^\\])*?"{3,5}', re.DOTALL),
    re.compile(r"'''.*?'{3,5}", re.DOTALL),
    re.compile(r'"(?:\\.|[^"\\\n])*"'),
    re.compile(r"'[^'\n]*'"),
)


def toml_positions(text: str, file: str) -> dict[str, str]:
    """Dotted key -> ``file:line``, inline tables and arrays of tables included."""
    return _Scanner(text, file).scan()


class _Scanner:
    def __init__(self, text: str, file: str) -> None:
        self.text = text
        self.file = file
        self.at = 0
        self.out: dict[str, str] = {}
        self.last: dict[str, int] = {}  # arrays of tables: key -> index of the newest item

    def scan(self) -> dict[str, str]:
        table = ""
        self.skip(_BLANK)
        while self.at < len(self.text):
            if self.text[self.at] == "[":
                table = self.header()
            else:
                self.pair(table)
            self.skip(_BLANK)
        return self.out

    def skip(self, pattern: re.Pattern[str]) -> str:
        match = pattern.match(self.text, self.at)
        if match is None:
            return ""
        self.at = match.end()
        return match[0]

    def mark(self, key: str, start: int) -> None:
        self.out[key] = f"{self.file}:{self.text.count(chr(10), 0, start) + 1}"

    def header(self) -> str:
        start = self.at
        array = self.text.startswith("[[", self.at)
        self.at += 2 if array else 1
        names = self.names()
        self.at += 2 if array else 1
        key = ""
        for position, name in enumerate(names):
            key = keys.child(key, name)
            final = position == len(names) - 1
            if array and final:
                self.out.setdefault(key, f"{self.file}:{self.text.count(chr(10), 0, start) + 1}")
                self.last[key] = self.last.get(key, -1) + 1
            if key in self.last:
                key = keys.child(key, self.last[key])
        self.mark(key, start)
        return key

    def names(self) -> list[str]:
        """``a . "b c" . d`` with the blanks around it."""
        found: list[str] = []
        while True:
            self.skip(_SPACE)
            quoted = self.string()
            if quoted:
                found.extend(tomli.loads(f"{quoted} = 0"))  # its escapes are TOML's own
            else:
                found.append(self.skip(_BARE))
            self.skip(_SPACE)
            if self.text[self.at : self.at + 1] != ".":
                return found
            self.at += 1

    def pair(self, table: str) -> None:
        start = self.at
        key = table
        for name in self.names():
            key = keys.child(key, name)
            self.mark(key, start)
        self.at += 1  # the equals sign
        self.skip(_SPACE)
        self.value(key)

    def value(self, key: str) -> None:
        opening = self.text[self.at]
        if opening == "[":
            self.items(key, "]")
        elif opening == "{":
            self.items(key, "}")
        elif not self.string():
            self.skip(_SCALAR)

    def items(self, key: str, closing: str) -> None:
        self.at += 1
        index = 0
        self.skip(_BLANK)
        while self.text[self.at] != closing:
            if closing == "]":
                inner = keys.child(key, index)
                self.mark(inner, self.at)
                self.value(inner)
            else:
                self.pair(key)
            index += 1
            self.skip(_BLANK)
            if self.text[self.at] == ",":
                self.at += 1
                self.skip(_BLANK)
        self.at += 1

    def string(self) -> str:
        for pattern in _STRINGS:
            found = self.skip(pattern)
            if found:
                return found
        return ""
