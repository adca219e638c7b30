"""The plan of ``fluxvla run``: config, section and work dir, checked before anything is built."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from fluxvla_core.config.check import Checked, Use, check_config, examine, type_key
from fluxvla_core.config.load import CONFIG_FILE, load_config
from fluxvla_core.config.overrides import apply_overrides
from fluxvla_core.config.signature import Signature
from fluxvla_core.config.tree import Config, join_key
from fluxvla_core.errors import UsageError, nearest

CKPT_PATH = "ckpt_path"
"""The key under which a section names the checkpoint that it uses."""


@dataclass(frozen=True)
class Plan:
    """One section of one checked config, and where its results go."""

    config: Config
    section: str
    trains: bool
    work_dir: Path
    uses: tuple[Use, ...]

    @property
    def signature(self) -> Signature | None:
        """The constructor of the section's runner; None if it cannot be read."""
        return next(use.found.signature for use in self.uses if use.key == self.section)


def make_plan(
    file: str | None,
    section: str | None = None,
    overrides: Iterable[str] = (),
    work_dir: str | None = None,
    settings: Mapping[str, str] | None = None,
) -> Plan:
    """Load, override and check a config, and choose the section.

    Args:
        settings: keys of the chosen section that options of the command line set.

    Raises:
        UsageError: no config is named, or the section is not one that can run.
        ConfigError: the config has problems.
    """
    overrides = tuple(overrides)
    if file is None:
        here = sorted(str(p) for p in Path("configs").glob("*") if p.suffix in {".py", ".toml"})
        listed = f"configs here: {', '.join(here[:8])}" if here else "fluxvla run --help"
        raise UsageError("no config given: fluxvla run --config FILE", next=listed)
    config = apply_overrides(load_config(file), overrides)
    examined = examine(config, section)
    config = _of_checkpoint(config, Path(file), examined, {f"--set {o}" for o in overrides})
    name = choose_section(config, examined, section)
    config = _with_settings(config, name, settings or {})
    checked = check_config(config, name)
    others = [one for one in examined.sections if one not in examined.trains]
    place = Path(work_dir) if work_dir is not None else default_work_dir(Path(file), others)
    return Plan(config, name, name in checked.trains, place, checked.uses)


def _of_checkpoint(config: Config, file: Path, examined: Checked, given: Collection[str]) -> Config:
    """For a checkpoint's own config: ``ckpt_path`` set to that checkpoint, unless it was given."""
    if not _in_checkpoint(file):
        return config
    for use in examined.uses:
        signature = use.found.signature
        if use.key not in examined.sections or signature is None or signature.trains:
            continue
        named = config.origins.get(join_key(use.key, CKPT_PATH)) in given
        if CKPT_PATH in signature.names and not named:
            config = _with_settings(config, use.key, {CKPT_PATH: str(file.parent)}, str(file))
    return config


def _in_checkpoint(file: Path) -> bool:
    if file.name != CONFIG_FILE:
        return False
    from fluxvla_core.checkpoints import manifest  # brings what checks it

    return (file.parent / manifest.NAME).is_file()


def _with_settings(
    config: Config, section: str, settings: Mapping[str, str], place: str | None = None
) -> Config:
    tree = {**config.tree, section: {**config.tree[section], **settings}}
    places = {join_key(section, key): place or f"--{key}" for key in settings}
    origins = {**config.origins, **places}
    return replace(config, tree=tree, origins=origins)


def choose_section(config: Config, checked: Checked, wanted: str | None) -> str:
    """``wanted``, or the only runnable section.

    Raises:
        UsageError: ``wanted`` is not there or cannot run; or there are several, or none.
        ConfigError: none, or not ``wanted``, because the config has problems.
    """
    names = checked.sections
    listed = ", ".join(f"{name} ({config.tree[name].get('type')})" for name in names)
    if wanted is not None:
        if wanted in names:
            return wanted
        if type_key(wanted) in {problem.key for problem in checked.problems}:
            raise checked.error()  # without its plugin nothing shows that it is a runner's table
        if wanted in config.tree:
            what = f"section {wanted!r} cannot be run: it is not a table whose type is a runner"
        else:
            near = nearest(wanted, names)
            what = f"no section {wanted!r}" + (f"; did you mean {near!r}?" if near else "")
        raise UsageError(what, where=config.file, next=f"sections there: {listed or 'none'}")
    if len(names) == 1:
        return names[0]
    if names:
        raise UsageError(
            f"several sections can be run: {listed}",
            where=config.file,
            next=f"name one: --section {names[0]}",
        )
    if checked.problems:
        raise checked.error()
    raise UsageError(
        "nothing to run: no table at the top has a type that is a runner",
        where=config.file,
        next="write runner = dict(type='...'); fluxvla plugins list shows what is installed",
    )


def default_work_dir(file: Path, sections: Collection[str] = ()) -> Path:
    """``work_dirs/<name of the config>``; for a run's resolved config, that run's own work dir.

    Args:
        sections: those that do not train. In the work dir of a training each leaves its resolved
            config in a folder of its name.
    """
    if file.name != CONFIG_FILE:
        return Path("work_dirs") / file.stem
    folder = file.parent
    if folder.parent.name == "checkpoints":
        return folder.parent.parent
    if _in_checkpoint(file):  # exported: nothing of a run is written into it
        return Path("work_dirs") / folder.name
    of_section = folder.name in sections and (folder.parent / CONFIG_FILE).is_file()
    return folder.parent if of_section else folder


def refuse_overwriting(work_dir: Path, resume: str | None) -> None:
    """Refuse a training in a work dir that has checkpoints of another.

    Checked here, too, and not only where training begins: a restart would continue from them.

    Args:
        resume: the checkpoint to resume from: ``auto``, a path, or None for nothing.

    Raises:
        UsageError: there are checkpoints, with both ways on.
    """
    from fluxvla_core.checkpoints.checkpoint import refuse_existing

    if resume == "auto":
        return
    here = os.path.realpath(work_dir)
    if resume is not None and Path(os.path.realpath(resume)).is_relative_to(here):
        return
    refuse_existing(work_dir)
