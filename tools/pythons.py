"""An environment with Python 3.13, for the parts of FluxVLA that need no torch."""

from __future__ import annotations

import dataclasses
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from tools import project, shell
from tools.envs import Env

VERSION = "3.13"
PLUGINS = ("fluxvla-aloha", "fluxvla-latency", "fluxvla-ur", "fluxvla-wandb")
"""Those that import no torch, and whose requirements have wheels for it."""
NIGHTLY = ("3.11", VERSION)
"""The versions that some session of every night runs; no classifier names another."""
EXTRAS = "data,record,testing"
"""Of the core: those that bring no torch."""
NEED_MORE = (
    "tests/cli/test_heartbeat.py",  # torch, and the report
    "tests/cli/test_new_plugin.py",  # a model among the plugins
    "tests/config/test_schema.py",  # all plugins
    "tests/contracts/test_check.py",  # torch, as all that follow but the last
    "tests/data/test_collator.py",
    "tests/data/test_dataset.py",
    "tests/data/test_decoder_threads.py",
    "tests/data/test_earlier_observations.py",
    "tests/data/test_inference_dataset.py",
    "tests/data/test_lerobot_oracle.py",
    "tests/data/test_loader.py",
    "tests/data/test_mixture.py",
    "tests/data/test_preparation.py",
    "tests/data/transforms/test_deferral.py",
    "tests/data/transforms/test_pipeline.py",
    "tests/data/test_tokenizer.py",  # tokenizers, and a package with one
)
"""Tests among those below that need packages that are not installed."""
TESTED = (
    "-m",
    "not network and not realtime and not slow",
    *(f"--ignore={path}" for path in NEED_MORE),
    "tests/cli",
    "tests/config",
    "tests/contracts",
    "tests/data",
    "tests/evaluation",
    "tests/plugins",
    "tests/robot",
    "tests/test_spec.py",
    "tests/test_hooks.py",
    "tests/test_registries.py",
    "tests/testing/test_action_filter_kit.py",
    "tests/testing/test_environment_kit.py",
    "tests/testing/test_hook_kit.py",
    "tests/testing/test_policy_kit.py",
    *(f"plugins/{name}" for name in PLUGINS),
)


def find() -> Path | None:
    """A Python of ``VERSION``: on the PATH, or one that pyenv has; None without one."""
    return next((path for path in _places() if _is_it(path)), None)


def _places() -> Iterator[Path]:
    named = shutil.which(f"python{VERSION}")
    if named is not None:
        yield Path(named)
    root = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    yield from sorted(root.glob(f"versions/{VERSION}*/bin/python{VERSION}"), reverse=True)


def _is_it(path: Path) -> bool:
    """pyenv's shims are there for every version, and run only those that are chosen."""
    words = [str(path), "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return done.returncode == 0 and done.stdout.strip() == VERSION


@dataclasses.dataclass(frozen=True)
class OtherPython(Env):
    """An environment of another Python, ``interpreter``, than the one that runs this."""

    interpreter: Path

    def create(self) -> None:
        """Make it again, empty."""
        shutil.rmtree(self.root, ignore_errors=True)
        shell.run([self.interpreter, "-m", "venv", self.root])


def filled(root: Path, needs: Sequence[str], log: Callable[[str], None]) -> Env:
    """The environment ``.nox/py313``, with core and plugins in editable mode.

    Args:
        needs: the tools, as the group ``dev`` of pyproject.toml names them.

    Raises:
        StepFailed: there is no such Python here, or something cannot be installed.
    """
    python = find()
    if python is None:
        missing = f"there is no python{VERSION} on this machine: install it (apt, pyenv, uv)"
        raise shell.StepFailed([f"python{VERSION}"], 127, missing)
    env = OtherPython(root / ".nox" / "py313", python)
    dists = [d for d in project.distributions(root) if d.path == root or d.name in PLUGINS]
    parts = {d.name: project.digest([d.path / "pyproject.toml"], relative_to=d.path) for d in dists}

    def base() -> None:
        log(f"installing {len(needs)} tools, with {python}")
        env.pip_install(*needs, constraints=project.CONSTRAINTS)

    def install(changed: list[str], fresh: bool) -> None:
        log(f"installing in editable mode: {', '.join(changed)}")
        words = []
        for dist in (d for d in dists if d.name in changed):
            extras = f"[{EXTRAS}]" if dist.path == root else ""
            words += ["-e", f"{dist.path}{extras}"]
        env.pip_install("--no-build-isolation", *words, constraints=project.CONSTRAINTS)

    described = {"python": str(python), "constraints": project.CONSTRAINTS.read_text("utf-8")}
    env.filled({**described, "requirements": " ".join(needs)}, parts, base, install)
    return env
