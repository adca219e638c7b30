"""What goes wrong between two episodes, while the arm is held: in the folder of the one before.

Its record is complete by then, and there may be no other.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from fluxvla_core.errors import RunFailed

LINES = "held.jsonl"


def note_trip(folder: Path, **fields: Any) -> None:
    """Append one line of JSON, with ``time``, the wall clock's.

    Raises:
        RunFailed: it cannot be written.
    """
    place = folder / LINES
    try:
        with place.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"time": time.time(), **fields}) + "\n")
    except OSError as error:
        raise RunFailed(f"a trip could not be recorded: {error}", where=str(place)) from error
