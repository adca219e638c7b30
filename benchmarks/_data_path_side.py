"""One side of ``data_path.py``: samples a second, read at random, of the datasets that it made.

    python _data_path_side.py fluxvla|lerobot FOLDER SECONDS

Prints JSON. Runs in the environment of its side; each imports its own half only.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

BATCH = 8
CHUNK = 50
FPS = 30
CAMERAS = ("front", "left", "right")
WORKERS = (2, 0)
"""Workers first: LeRobot's open decoders do not survive the fork that makes them."""
KINDS = ("mp4", "parquet")
WARM_UP = 4
"""Batches before the clock starts: workers begin, files are opened."""


def fluxvla(root: Path, kind: str, workers: int) -> Iterable[Any]:
    from fluxvla_core.data.dataset import ParquetDataset
    from fluxvla_core.data.loader import DictCollator, make_loader
    from fluxvla_core.data.sampler import StepPlan, StepSampler

    cameras = CAMERAS if kind == "mp4" else ()
    dataset = ParquetDataset(str(root), [], cameras, action_window_size=CHUNK)
    images = ("images", "img_masks") if cameras else ()
    keys = [*images, "states", "actions", "action_masks", "timestamp", "sample_ids"]
    collate = DictCollator(keys, ["task_description", "info"])
    return make_loader(dataset, collate, StepSampler(StepPlan(len(dataset), BATCH)), workers)


def lerobot(root: Path, kind: str, workers: int) -> Iterable[Any]:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from torch.utils.data import DataLoader

    steps = {"action": [j / FPS for j in range(CHUNK)]}
    dataset: Any = LeRobotDataset("bench/data", root, delta_timestamps=steps)

    def forever() -> Iterator[Any]:
        while True:
            yield from DataLoader(dataset, BATCH, shuffle=True, num_workers=workers, drop_last=True)

    return forever()


SIDES = {"fluxvla": fluxvla, "lerobot": lerobot}
PARTS = {
    "fluxvla": ("fluxvla-core", "torch", "av", "numpy", "pyarrow"),
    "lerobot": ("lerobot", "torch", "torchcodec", "datasets", "pyarrow"),
}


def rate(batches: Iterable[Any], seconds: float) -> dict[str, Any]:
    """Samples a second over at least ``seconds``, the processor's time of a sample in this process
    (ms), and what a batch holds."""
    source = iter(batches)
    for _ in range(WARM_UP):
        batch = next(source)
    shapes = [f"{k} {tuple(v.shape)} {v.dtype}" for k, v in batch.items() if hasattr(v, "shape")]
    began, busy = time.perf_counter(), time.process_time()
    count = 0
    while time.perf_counter() - began < seconds:
        next(source)
        count += BATCH
    return {
        "samples_per_s": count / (time.perf_counter() - began),
        "cpu_ms": (time.process_time() - busy) / count * 1e3,
        "batch": shapes,
    }


def main(side: str, folder: str, seconds: str) -> None:
    rates = {
        f"{kind}, {workers} workers": rate(
            SIDES[side](Path(folder) / kind, kind, workers), float(seconds)
        )
        for kind in KINDS
        for workers in WORKERS
    }
    versions = {name: version(name) for name in PARTS[side]}
    print(json.dumps({"rates": rates, "versions": versions}))


if __name__ == "__main__":
    main(*sys.argv[1:])
