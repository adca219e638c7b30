"""How a run that goes on differs from the one that saved its checkpoint: settings and data."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Set
from typing import Any

TABLES = ("model", "train_dataloader", "val_dataloader")
"""What a run, and its best checkpoint, follow from, besides the section that runs."""
HARMLESS = frozenset(
    {
        # Where things are. A model's frozen weights are compared by their sum, data by statistics.
        *("init_from", "resume_from", "device"),
        # How samples are fetched.
        *("per_device_num_workers", "cache_frames"),
        # What is told and saved, and how often.
        *("metric", "log_iter_interval", "peak_tflops", "val_iter_interval"),
        *("save_epoch_interval", "save_iter_interval", "max_keep_ckpts", "async_save"),
        "early_stop_patience",  # how long it goes on
        # Samples a step: what they come to together is compared on its own.
        *("per_device_batch_size", "grad_accumulation_steps"),
    }
)
"""Keys that may change without a word."""
LENGTH = frozenset({"max_epochs", "max_steps"})
"""And those that may where the learning rate does not follow from them."""
_UNSET = "not set"
_ADDRESS = re.compile(r" at 0x[0-9a-f]+")


def plain(config: Any) -> Any:
    """``config`` as JSON values; objects, which one made in Python may hold, are described."""
    return json.loads(json.dumps(config, default=_described))


def _described(value: Any) -> str:
    """Where it lies in memory is another place in every process."""
    return _ADDRESS.sub("", repr(value))


def changed_settings(
    saved: Mapping[str, Any], ours: Mapping[str, Any], section: str
) -> dict[str, tuple[str, str]]:
    """Keys of the running ``section`` and of :data:`TABLES` that differ, and both values.

    Args:
        saved: the checkpoint's config tree.
        ours: the present one's.

    Returns:
        Dotted key -> (before, now), as JSON or ``not set``.
    """
    steady = all(_steady(tree[section]) for tree in (saved, ours) if section in tree)
    harmless = HARMLESS | LENGTH if steady else HARMLESS
    before, now = (
        {
            key: value
            for name in (section, *TABLES)
            for key, value in _leaves(name, plain(tree.get(name) or {}), harmless)
        }
        for tree in (saved, ours)
    )
    return {
        key: (before.get(key, _UNSET), now.get(key, _UNSET))
        for key in {**before, **now}
        if before.get(key) != now.get(key)
    }


def _steady(runner: Mapping[str, Any]) -> bool:
    """Whether the learning rate of a step is the same however long the run is."""
    constant = runner.get("lr_scheduler_type", "constant") == "constant"
    return constant and not runner.get("warmup_ratio")


def _leaves(name: str, value: Any, harmless: Set[str]) -> Iterator[tuple[str, str]]:
    """Dotted keys below ``name`` with their values as text; lists of tables count from 0."""
    if isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
        value = {str(i): item for i, item in enumerate(value)}
    if not isinstance(value, Mapping):
        yield name, json.dumps(value, ensure_ascii=False)
        return
    for key, item in value.items():
        if key not in harmless and not key.endswith("_path"):
            yield from _leaves(f"{name}.{key}", item, harmless)


def changed_statistics(saved: Any, ours: Any, name: str = "") -> list[str]:
    """Dotted names of statistics that differ by more than another machine's rounding does."""
    if isinstance(saved, Mapping) and isinstance(ours, Mapping):
        return [
            found
            for key in {**saved, **ours}
            for found in changed_statistics(
                saved.get(key), ours.get(key), f"{name}.{key}".strip(".")
            )
        ]
    if isinstance(saved, list) and isinstance(ours, list) and len(saved) == len(ours):
        pairs = zip(saved, ours, strict=True)
        return [name] if any(changed_statistics(a, b, name) for a, b in pairs) else []
    numbers = all(isinstance(v, int | float) for v in (saved, ours))
    same = math.isclose(saved, ours, rel_tol=1e-5, abs_tol=1e-8) if numbers else saved == ours
    return [] if same else [name]
