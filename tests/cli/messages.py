"""What the toy runners of these tests wrote about their run."""

from __future__ import annotations

import json
from pathlib import Path


def said(folder: str = "work_dirs/c", rank: int = 0) -> dict[str, object]:
    found: dict[str, object] = json.loads((Path(folder) / f"said-{rank}.json").read_text())
    return found
