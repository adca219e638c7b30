"""Finishing a recording that was cut short, so that ROS tools open it as well."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

from fluxvla_core import atomic
from fluxvla_core.errors import DataError
from fluxvla_core.record import ros_messages as ros
from fluxvla_core.record.mcap import McapFile
from fluxvla_core.record.recording import bag_of, open_recording
from fluxvla_core.record.trace import SUMMARY


def finish_recording(folder: str | Path) -> bool:
    """Write the index of a bag that lacks one, its ``metadata.yaml``, and ``episode.json``.

    The bag is written anew aside and put in its place in one step; its messages stay as they are.

    Args:
        folder: one episode.

    Returns:
        Whether there was anything to do.

    Raises:
        DataError: it holds no bag, or nothing that can be read.
        RunFailed: rosbags is not installed.
    """
    place = Path(folder)
    recorded = open_recording(place)
    bag = bag_of(place) if place.is_dir() else None
    if bag is None:
        raise DataError("only an episode's folder with a bag can be finished", where=str(place))
    if recorded.whole and (place / "metadata.yaml").is_file():
        return False
    aside = place.with_name(f".{place.name}.finishing")
    shutil.rmtree(aside, ignore_errors=True)
    try:
        written = aside / bag.stem
        _rewrite(McapFile(bag), written)
        os.replace(written / bag.name, bag)
        os.replace(written / "metadata.yaml", place / "metadata.yaml")
    finally:
        shutil.rmtree(aside, ignore_errors=True)
    if not (place / SUMMARY).exists():
        atomic.write_text(place / SUMMARY, json.dumps(recorded.summary(), indent=1) + "\n")
    return True


def _rewrite(file: McapFile, out: Path) -> None:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    store = ros.typestore()
    writer = Writer(out, version=8, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    channels: dict[str, Any] = {}
    with writer:
        for entry in file.entries():
            if entry.topic not in channels:
                channels[entry.topic] = writer.add_connection(
                    entry.topic, entry.kind, typestore=store
                )
            writer.write(channels[entry.topic], entry.ns, entry.data)
