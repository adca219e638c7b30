"""Config files: read (``.py``, ``.toml``, ``config.resolved.json``), and written for a run."""

from __future__ import annotations

import ast
import json
import os
import types
from pathlib import Path
from typing import Any

from fluxvla_core.config.positions import py_positions
from fluxvla_core.config.tree import Config, all_keys, join_bases, merge, plain, shown, strip
from fluxvla_core.errors import ConfigError, Problem
from fluxvla_core.plugins._metadata import CORE, index, version
from fluxvla_core.plugins.load import locate
from fluxvla_core.untrusted import AT_MOST, read_bytes

BASE = "_base_"
CONFIG_FILE = "config.resolved.json"
"""The resolved config in a run's work dir, which can be run again."""
FORMAT = "fluxvla-config-1"
SUFFIXES = (".py", ".toml", ".json")
DEEPEST = 100
"""Levels of tables and lists in a config; this project's own have fewer than 10."""
MOST_KEYS = 5_000
"""Most keys of all tables together; this project's own configs have fewer than 500."""
_LONGEST_CHAIN = 50  # files
_LONGEST_FILE = 1 << 20  # bytes
ENVIRONMENT_FILE = "environment.json"
_LOOKED_AT = 2000  # folders: a hint is not worth a walk over a whole disk
_PACKAGES = ("torch", "numpy", "pyarrow", "av", "mujoco", "transformers", "rclpy")


def load_config(path: str | Path) -> Config:
    """The config in ``path`` with everything that it inherits.

    A ``.py`` config is a program that the user chose to run; its public names that hold plain
    data become the tree. ``.toml`` and ``.json`` are data and nothing is executed, and a ``.py``
    that lies in a checkpoint is refused.

    Raises:
        ConfigError: it is missing, no file, of another kind, has a syntax error, raises, holds
            something else than plain data, or its inheritance does not work out.
    """
    return _load(Path(path), (), {})


def _load(path: Path, chain: tuple[Path, ...], loaded: dict[Path, Config]) -> Config:
    """Load ``path``, which the files of ``chain`` inherit; ``loaded`` has the files read before.

    Each file is read once: if 25 files each name the next one twice, the last would otherwise be
    read 16 million times.
    """
    _check_there(path)
    resolved = Path(os.path.realpath(path))
    if resolved in chain:
        names = " -> ".join(shown(p) for p in (*chain[chain.index(resolved) :], resolved))
        raise ConfigError(f"circular {BASE}: {names}", where=shown(chain[-1]))
    if len(chain) >= _LONGEST_CHAIN:
        raise ConfigError(
            f"a chain of more than {_LONGEST_CHAIN} files by {BASE}", where=shown(chain[0])
        )
    if resolved not in loaded:
        loaded[resolved] = _load_file(path, (*chain, resolved), loaded)
    return loaded[resolved]


def _load_file(path: Path, chain: tuple[Path, ...], loaded: dict[Path, Config]) -> Config:
    name = shown(path)
    if path.suffix == ".json":
        return _from_json(_read(path), name)
    if path.suffix == ".toml":
        own = _from_toml(_read(path), name)
    else:
        own = _from_python(_read(path), name, path)
    bases = own.tree.pop(BASE, None)
    if bases is None:
        return Config(strip(own.tree), own.origins, name)
    listed = [bases] if isinstance(bases, str) else bases
    if not isinstance(listed, list) or not all(isinstance(b, str) for b in listed):
        raise ConfigError(
            f"{BASE} must be a file name or a list of them, got {bases!r}", where=own.where(BASE)
        )
    places = {k: v for k, v in own.origins.items() if k.partition(".")[0] != BASE}
    if not listed:
        return Config(strip(own.tree), places, name)
    found = [_load(_base_path(b, path, own.where(BASE)), chain, loaded) for b in listed]
    return merge(join_bases(found), Config(own.tree, places, name))


def _check_there(path: Path) -> None:
    name = shown(path)
    if path.is_dir():
        inside = sorted(p.name for p in path.iterdir() if p.suffix in SUFFIXES)
        raise ConfigError(
            "this is a directory, not a config file",
            where=name,
            next=f"name one of the configs in it: {', '.join(inside)}" if inside else None,
        )
    if not path.exists():
        folder = path.parent
        if not folder.is_dir():
            raise ConfigError(f"no such config: there is no folder {shown(folder)}", where=name)
        others = sorted(p.name for p in folder.iterdir() if p.suffix in SUFFIXES)
        import difflib

        near = difflib.get_close_matches(path.name, others, 3)
        hint = f"; did you mean {' or '.join(str(path.with_name(n)) for n in near)}?"
        raise ConfigError(
            f"no such config{hint if near else ''}",
            where=name,
            next=f"configs there: {', '.join(others)}" if others and not near else None,
        )
    if path.suffix not in SUFFIXES:
        raise ConfigError(
            f"a config is a .py, .toml or .json file, not {path.suffix or 'one without a suffix'}",
            where=name,
        )


def _read(path: Path) -> str:
    # A resolved config may list episodes by the thousand, each with its place; people's do not.
    at_most = AT_MOST if path.suffix == ".json" else _LONGEST_FILE
    try:
        text = read_bytes(path, ConfigError, at_most=at_most).decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"not a text file in UTF-8 (byte {error.start})", where=shown(path)
        ) from error
    except ConfigError as error:
        raise ConfigError(error.what, where=shown(path)) from error
    return text.replace("\r\n", "\n")


def _base_path(base: str, child: Path, where: str) -> Path:
    """A file next to ``child``, or ``package:path`` inside an installed plugin (not imported)."""
    package, colon, inside = base.partition(":")
    if not colon or not package.isidentifier():
        path = child.parent / base
        if not path.exists():
            raise ConfigError(f"{BASE} names {base!r}, which is not there", where=where)
        return path
    init = locate(package)
    if init is None:
        raise ConfigError(
            f"{BASE} names {base!r}, but no package {package!r} is installed",
            where=where,
            next="fluxvla plugins list",
        )
    path = init.parent / inside
    if not path.exists():
        raise ConfigError(f"{BASE} names {base!r}, but {package} has no {inside!r}", where=where)
    return path


def _check_size(values: Any, name: str) -> None:
    """Refuse a config that is larger than people write: to check it would take minutes, and
    recursion over it could fail."""
    level, count = [values], 0
    for _ in range(DEEPEST + 1):
        count += sum(len(table) for table in level if isinstance(table, dict))
        level = [
            item
            for table in level
            for item in (table.values() if isinstance(table, dict) else table)
            if isinstance(item, (dict, list, tuple))
        ]
    if level:
        raise _too_deep(name)
    if count > MOST_KEYS:
        raise ConfigError(f"{count} keys; {MOST_KEYS} are the most that are read", where=name)


def _too_deep(name: str) -> ConfigError:
    return ConfigError(f"tables and lists are nested deeper than {DEEPEST}", where=name)


def _finish(values: dict[str, Any], origins: dict[str, str], name: str) -> Config:
    found: list[tuple[str, str]] = []
    tree = plain(values, "", found)
    config = Config(tree, origins, name)
    if found:
        raise ConfigError.from_problems(tuple(config.problem(k, what) for k, what in found))
    return config


def _from_python(text: str, name: str, path: Path) -> Config:
    if (path.parent / "manifest.json").is_file():
        raise ConfigError(
            "a .py that lies in a checkpoint is not executed: what comes with weights is data",
            where=name,
            next=f"use its {path.with_name('config.resolved.json')}",
        )
    try:
        tree = ast.parse(text, name)
        code = compile(tree, name, "exec")
    except SyntaxError as error:
        raise ConfigError(
            f"syntax error: {error.msg}{_quote(error.text)}", where=f"{name}:{error.lineno}"
        ) from error
    except ValueError as error:  # null bytes, before Python 3.12
        raise ConfigError(f"not Python: {error}", where=name) from error
    except (RecursionError, MemoryError) as error:
        raise _too_deep(name) from error
    values: dict[str, Any] = {"__file__": str(path.resolve()), "__name__": "fluxvla_config"}
    try:
        exec(code, values)
    except KeyboardInterrupt:
        raise
    except (Exception, SystemExit) as error:
        raise ConfigError(
            f"the config raised {type(error).__name__}: {error}",
            where=f"{name}:{_line(error, name)}",
        ) from error
    data = {k: v for k, v in values.items() if k == BASE or _is_data(k, v)}
    _check_size(data, name)
    return _finish(data, py_positions(tree, name), name)


def _is_data(name: str, value: Any) -> bool:
    """Whether it is a key: imports, functions and paths of a ``.py`` config are not."""
    if name.startswith("_") or isinstance(value, types.ModuleType):
        return False
    return value is None or isinstance(value, (bool, int, float, str, list, tuple, dict))


def _line(error: BaseException, name: str) -> int:
    """The config's own line that the exception passed through last."""
    line, step = 0, error.__traceback__
    while step is not None:
        if step.tb_frame.f_code.co_filename == name:
            line = step.tb_lineno
        step = step.tb_next
    return line


def _quote(text: str | None) -> str:
    return f" in {text.strip()!r}" if text and text.strip() else ""


def _unreadable(error: Exception, name: str) -> ConfigError:
    """The error for text that the parsers of TOML and JSON give up on."""
    if isinstance(error, RecursionError):
        return _too_deep(name)
    # A whole number of thousands of digits.
    return ConfigError(f"a value cannot be read: {error}", where=name)


def _from_toml(text: str, name: str) -> Config:
    import tomli

    from fluxvla_core.config.positions import toml_positions

    try:
        values = tomli.loads(text)
    except tomli.TOMLDecodeError as error:
        line = text.splitlines()[error.lineno - 1 : error.lineno]
        raise ConfigError(
            f"syntax error: {error.msg} (column {error.colno}){_quote(line[0] if line else None)}",
            where=f"{name}:{error.lineno}",
        ) from error
    except (ValueError, RecursionError) as error:
        raise _unreadable(error, name) from error
    _check_size(values, name)
    return _finish(values, toml_positions(text, name), name)


def _from_json(text: str, name: str) -> Config:
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise ConfigError(f"syntax error: {error.msg}", where=f"{name}:{error.lineno}") from error
    except (ValueError, RecursionError) as error:
        raise _unreadable(error, name) from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        found = data.get("format") if isinstance(data, dict) else None
        raise ConfigError(
            f"a .json config is the config.resolved.json of a run (format {FORMAT!r}), "
            f"this has format {found if found is None else str(found)[:80]!r}",
            where=name,
            next="write configs as .py or .toml",
        )
    tree, origins = data.get("config"), data.get("origins", {})
    if not isinstance(tree, dict) or not isinstance(origins, dict):
        raise ConfigError("'config' and 'origins' must be tables", where=name)
    _check_size(tree, name)
    problems = tuple(
        Problem(name, key, f"an origin must be 'file:line', got {value!r}")
        for key, value in origins.items()
        if not isinstance(value, str)
    )
    if problems:
        raise ConfigError.from_problems(problems)
    there = set(all_keys(tree))
    return _finish(tree, {k: v for k, v in origins.items() if k in there}, name)


# -- files of a work dir ---------------------------------------------------------------------------


def write_resolved(path: Path, config: Config) -> None:
    """Write ``config`` so that ``load_config(path)`` gives it back, key for key.

    Raises:
        OSError: as opening, writing and renaming do; an older file stays as it was.
    """
    from fluxvla_core import atomic

    atomic.write_json(
        path,
        {"format": FORMAT, "config": config.tree, "origins": dict(sorted(config.origins.items()))},
    )


def environment() -> dict[str, Any]:
    """Versions of Python, the core, every installed plugin and the main libraries.

    Read from metadata; nothing is imported.
    """
    import platform

    plugins = [
        plugin.to_dict() for _, providers in sorted(index().plugins.items()) for plugin in providers
    ]
    return {
        "format": "fluxvla-environment-1",
        "python": platform.python_version(),
        "platform": platform.platform(),
        CORE: version(CORE),
        "packages": {name: have for name in _PACKAGES if (have := version(name))},
        "plugins": plugins,
    }


def work_dirs_below(folder: Path, depth: int = 3) -> list[Path]:
    """Work dirs of earlier runs in ``folder``, for a hint: the newest first, not all of many."""
    found: list[tuple[float, Path]] = []
    level, looked = [folder], 0
    for _ in range(depth):
        below: list[Path] = []
        for place in level:
            for inner in _folders_in(place):
                looked += 1
                config = inner / CONFIG_FILE
                if looked > _LOOKED_AT:
                    break
                if config.is_file():  # folders inside are its sections' and checkpoints'
                    found.append((config.stat().st_mtime, inner))
                else:
                    below.append(inner)
        level = below
    return [path for _, path in sorted(found, reverse=True)]


def _folders_in(place: Path) -> list[Path]:
    try:
        return [p for p in place.iterdir() if not p.name.startswith(".") and p.is_dir()]
    except OSError:  # not ours to read, or gone by now
        return []
