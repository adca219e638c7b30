"""Packages of the extra ``data``, imported when they are first needed."""

from __future__ import annotations

import importlib
from typing import Any

from fluxvla_core.errors import ConfigError


def libav() -> Any:
    """PyAV. Raises ConfigError with the command that installs it."""
    return _load("av")


def reformatter() -> Any:
    """A fresh converter of pixel formats; it keeps its tables between frames."""
    return _load("av.video.reformatter").VideoReformatter()


def opencv() -> Any:
    """OpenCV."""
    return _load("cv2")


def arrow() -> Any:
    """pyarrow."""
    return _load("pyarrow")


def parquet() -> Any:
    """pyarrow.parquet."""
    return _load("pyarrow.parquet")


def _load(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise ConfigError(
            f"datasets need the package {package}, which cannot be imported: {error}",
            next="pip install 'fluxvla-core[data]'",
        ) from error
