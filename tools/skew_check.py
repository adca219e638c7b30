"""Version skew: the released core with plugins at head, and released plugins with the core at head.

People do not upgrade everything at once. Wheels of both states are installed into environments of
their own, and the plugins' conformance kits are run there: ``fluxvla plugins check``. Where the
plugins' bounds exclude the core, pip has to say so; what pip takes has to work. A plugin for
another version of its contract has to be refused in words.

The released state is a commit, built as a user would: the newest tag ``v...``, or, before the first
release, one that the noxfile names.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tarfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tools import project, rendering, wheels
from tools.envs import Env
from tools.shell import StepFailed

CORE = "fluxvla-core"
KITS: dict[str, tuple[tuple[str, ...], ...]] = {
    "fluxvla-latency": (("LatencyLog",),),
    "fluxvla-sim": (("AlohaSimOperator", "--simulated"),),
}
"""Distribution -> the arguments of ``fluxvla plugins check`` for its classes."""
PLUGINS = (*KITS, "fluxvla-aloha", "fluxvla-mujoco", "fluxvla-ur")
"""The installed distributions: those and their requirements, of the same state."""
SOURCES = ("pyproject.toml", "README.md", "LICENSE", "src", "plugins")
OTHER_API = re.compile(r"is written for \w+ 9\.0, this core speaks \d+\.\d+")


class Skewed(StepFailed):
    """A pair does not work together, and nobody says so in words."""

    def __init__(self, problem: str) -> None:
        super().__init__(("nox", "-s", "skew"), 1, problem)


@dataclass(frozen=True)
class Pair:
    """Sources of a core, and of plugins, each the root of a checkout or of what stands for one."""

    name: str
    core: Path
    plugins: Path


def released(root: Path, fallback: str, named: str | None = None) -> str:
    """The commit that counts as released, in full.

    Args:
        fallback: where there is no tag ``v...``; the newest one counts otherwise.
        named: counts in any case.

    Raises:
        Skewed: this clone does not have it.
    """
    tags = _git(root, "tag", "--list", "v*", "--sort=-version:refname") or ""
    commit = named or next(iter(tags.split()), fallback)
    found = _git(root, "rev-parse", "--verify", "--quiet", f"{commit}^{{commit}}")
    if found is None:
        raise Skewed(
            f"{commit} counts as released, and this clone does not have it (is it a shallow one?); "
            "name another: nox -s skew -- COMMIT"
        )
    return found


def unpack(root: Path, commit: str, folder: Path) -> Path:
    """The sources of ``commit`` in ``folder``, which holds nothing else; gives the folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    archive = folder.with_suffix(".tar")
    words = ["git", "-C", str(root), "archive", "--format=tar", "-o", str(archive), commit, "--"]
    subprocess.run([*words, *SOURCES], check=True)
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
    archive.unlink()
    return folder


def build(root: Path, names: Sequence[str], folder: Path, builder: Env) -> dict[str, Path]:
    """Wheels of the distributions ``names`` of the sources in ``root``."""
    dists = [dist for dist in project.distributions(root) if dist.name in names]
    lacks = sorted(set(names) - {dist.name for dist in dists})
    if lacks:
        raise Skewed(f"{root} has no {', '.join(lacks)}")
    return wheels.build(dists, folder, builder)


def check(pair: Pair, folder: Path, builder: Env) -> str:
    """Install a pair, and run the kits of its plugins; how it ended, in words.

    Raises:
        Skewed: what pip has taken does not work together.
    """
    core = build(pair.core, [CORE], folder / "core", builder)
    plugins = build(pair.plugins, PLUGINS, folder / "plugins", builder)
    env = Env(folder / "env")
    env.create()
    try:
        install(env, f"{core[CORE]}[testing]", *map(str, plugins.values()))
    except StepFailed as error:
        said = error.output
        if CORE not in said or "conflict" not in said.casefold():
            raise Skewed(f"{pair.name}: pip cannot install it:\n{said}") from error
        return f"{pair.name}: pip says that they do not fit"
    try:
        rendering.ensure(env, print)  # a simulated robot's cameras are drawn
    except rendering.CannotRender as error:
        raise Skewed(f"{pair.name}: {error}") from error
    for words in (each for one in KITS.values() for each in one):
        try:
            env.run("fluxvla", "plugins", "check", *words, quiet=True, env=rendering.VARIABLES)
        except StepFailed as error:
            raise Skewed(
                f"{pair.name}: pip takes them together, and the kit of {words[0]} fails:\n"
                f"{error.output}"
            ) from error
    return f"{pair.name}: the kits of {', '.join(KITS)} pass"


def check_refusal(pair: Pair, folder: Path, builder: Env) -> str:
    """A plugin that is written for another version of its contract is refused in words.

    Raises:
        Skewed: it is not.
    """
    name, ((kit, *_), *_) = next(iter(KITS.items()))
    source = next(dist for dist in project.distributions(pair.plugins) if dist.name == name)
    future = folder / "future"
    shutil.rmtree(future, ignore_errors=True)
    shutil.copytree(source.path, future)
    for path in future.rglob("*.py"):
        path.write_text(path.read_text(encoding="utf-8").replace('api = "1.0"', 'api = "9.0"'))
    env = Env(folder / "env")
    built = wheels.build([project.Distribution(name, future)], folder / "future_wheel", builder)
    install(env, "--force-reinstall", "--no-deps", str(built[name]))
    try:
        env.run("fluxvla", "plugins", "check", kit, quiet=True)
    except StepFailed as error:
        if error.status == 2 and OTHER_API.search(" ".join(error.output.split())):
            return f"{pair.name}: a {kit} for api 9.0 is refused in words"
        raise Skewed(f"{pair.name}: a {kit} for api 9.0 ends with:\n{error.output}") from error
    raise Skewed(f"{pair.name}: a {kit} for api 9.0 is taken as if it fitted")


def install(env: Env, *words: str) -> None:
    """pip install; what it says is in the error."""
    env.pip_install(*words, constraints=project.CONSTRAINTS, quiet=True)


def _git(root: Path, *words: str) -> str | None:
    done = subprocess.run(
        ["git", "-C", str(root), *words], capture_output=True, text=True, check=False
    )
    return done.stdout.strip() if done.returncode == 0 else None
