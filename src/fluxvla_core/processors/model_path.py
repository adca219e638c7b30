"""Where pretrained files are: a folder, or inside an installed package. Never a hub."""

from __future__ import annotations

from pathlib import Path

from fluxvla_core.errors import DataError
from fluxvla_core.plugins.locate import locate

PACKAGE = "package:"


def resolve_model_path(model_path: str | Path) -> Path:
    """The folder that ``model_path`` names.

    ``package:<module>/<folder>`` is a folder inside an installed package, which is found without
    being imported; anything else is a path.

    Raises:
        DataError: the package is not installed, or there is no such folder.
    """
    text = str(model_path)
    if not text.startswith(PACKAGE):
        folder = Path(text).expanduser()
        cause = "models are read from disk; nothing is fetched from a hub"
    else:
        module, _, inner = text.removeprefix(PACKAGE).partition("/")
        source = locate(module)
        if source is None:
            raise DataError(
                f"{text}: package {module!r} is not installed",
                next=f"pip install {module.replace('_', '-')}",
            )
        folder = source.parent / inner
        cause = f"this version of {module!r} carries no such folder"
    if not folder.is_dir():
        raise DataError(f"there is no folder {folder} with a pretrained model", cause=cause)
    return folder
