"""The implementations that ours are compared with, in environments of their own.

LeRobot 0.6.1 and the transformers that it was made for cannot share an environment with this
project. What they compute is stored once: a program ``plugins/*/tests/oracles/make_REFERENCE.py``
runs in such an environment and writes files of tensors, which the plugin's tests compare with
anywhere. ``nox -s oracles`` makes the environments, runs all these programs again and compares;
``tools/golden.py`` says what the programs have to keep to.

    python -m tools.oracle_env [NAME]     prints the Python of an environment (lerobot061)

LeRobot 0.6.1 is written for Python 3.12: with 3.11, the few lines of its installed copy whose
syntax is new are rewritten. What they say stays the same.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

from tools import lerobot_env, project, shell, torch_build
from tools.envs import Env

ORACLES = project.ROOT / ".nox" / "oracles"
LEROBOT = ("lerobot==0.6.1", "torchvision==0.28.0")
# What LeRobot's policies import, in the versions that go with 0.6.1.
NEEDS = (
    "accelerate",
    "av<16",
    "datasets>=4.8,<5",
    "deepdiff",
    "diffusers>=0.38,<0.40",
    "draccus>=0.11.6,<0.12",
    "einops",
    "gymnasium",
    "huggingface-hub<2",
    "imageio",
    "jsonlines",
    "opencv-python-headless",
    "packaging",
    "pandas",
    "protobuf",
    "pyarrow",
    "safetensors",
    "scipy",
    "sentencepiece",
    "termcolor",
    "transformers==5.5.4",
)
NEEDS_044 = ("huggingface-hub<1", "peft", "transformers==4.57.6")
POLICIES = (
    "act.modeling_act",
    "diffusion.modeling_diffusion",
    "groot.modeling_groot",
    "pi0.modeling_pi0",
    "pi05.modeling_pi05",
    "pi0_fast.modeling_pi0_fast",
    "smolvla.modeling_smolvla",
)
TRY_POLICIES = "\n".join(f"import lerobot.policies.{name}" for name in POLICIES)

# PEP 695: 'type Name = ...', 'class Name[A, B](Base):' and 'def name[A: Bound](...)'.
_ALIAS = re.compile(r"^type (\w+) = ", re.MULTILINE)
_CLASS = re.compile(r"^class (\w+)\[([\w, ]+)\](?:\((.*)\))?:$", re.MULTILINE)
_FUNCTION = re.compile(r"^def (\w+)\[(\w+)(?:: \w+)?\]\(", re.MULTILINE)
_FIRST_IMPORT = re.compile(r"^(?:import|from (?!__future__)) ?\w+", re.MULTILINE)


# For a program that writes golden files: off the net, and one thread, because sums depend on how
# they are divided.
VARIABLES = {
    "HF_HUB_OFFLINE": "1",
    "OMP_NUM_THREADS": "1",
    "PYTHONPATH": str(project.ROOT),
}


class OracleEnv(Env):
    """Made with ``venv``, and off the net when something runs in it."""

    def create(self) -> None:
        shell.run([sys.executable, "-m", "venv", "--clear", self.root], quiet=True, echo=False)

    def variables(self) -> dict[str, str]:
        return {
            **super().variables(),
            "HF_HUB_OFFLINE": "1",
            "HF_HOME": str(self.root / "hf"),
        }


def prepare(log: Callable[[str], None], root: Path = ORACLES / "lerobot061") -> Env:
    """Install what is missing; minutes the first time.

    Raises:
        StepFailed: something cannot be installed, or LeRobot's policies cannot be imported.
    """
    env = OracleEnv(root)
    version = project.constrained_version("torch")
    base = {"python": sys.version, "torch": version, "needs": " ".join(NEEDS)}

    def install_base() -> None:
        # No constraints: they are this project's, and LeRobot's needs are others.
        torch_build.install(env, version, None, log)
        env.pip_install(*NEEDS, quiet=True)

    def install_parts(changed: list[str], fresh: bool) -> None:
        env.pip_install("--no-deps", "--ignore-requires-python", *LEROBOT, quiet=True)
        adapt(env)
        env.run("python", "-c", TRY_POLICIES, quiet=True, echo=False)

    parts = {"lerobot": " ".join(LEROBOT) + lerobot_env.DECLARED + TRY_POLICIES}
    env.filled(base, parts, install_base, install_parts)
    return env


def prepare_044(log: Callable[[str], None]) -> Env:
    """LeRobot 0.4.4, the last one with GR00T N1.5, with the transformers that it was made for.

    Raises:
        StepFailed: something cannot be installed.
    """
    return lerobot_env.prepare(log, ORACLES / "lerobot044", NEEDS_044)


def adapt(env: Env) -> None:
    """Let the installed LeRobot and torchvision be imported here; done again, no more."""
    lerobot_env.declare_operators(env)
    lerobot_env.remove_tests(env)
    if sys.version_info >= (3, 12):
        return
    for module in env.root.glob("lib/python*/site-packages/lerobot/**/*.py"):
        text = module.read_text(encoding="utf-8")
        older = without_type_parameters(text)
        if older != text:
            module.write_text(older, encoding="utf-8")


def without_type_parameters(text: str) -> str:
    """A module's source with PEP 695's syntax at its top level replaced by that of Python 3.11."""
    names: set[str] = set()

    def generic(found: re.Match[str]) -> str:
        name, parameters, bases = found.groups()
        names.update(parameter.strip() for parameter in parameters.split(","))
        listed = f"{bases}, " if bases else ""
        return f"class {name}({listed}_typing.Generic[{parameters}]):"

    def function(found: re.Match[str]) -> str:
        names.add(found[2])
        return f"def {found[1]}("

    text = _FUNCTION.sub(function, _CLASS.sub(generic, _ALIAS.sub(r"\1 = ", text)))
    first = _FIRST_IMPORT.search(text)
    if not names or first is None:
        return text
    lines = [f'{name} = _typing.TypeVar("{name}")\n' for name in sorted(names)]
    head = "".join(["import typing as _typing\n", *lines])
    return text[: first.start()] + head + text[first.start() :]


# What a program's line ``ENVIRONMENT = "NAME"`` may say.
ENVIRONMENTS: dict[str, Callable[[Callable[[str], None]], Env]] = {
    "lerobot044": prepare_044,
    "lerobot061": prepare,
}


def main() -> int:
    name = sys.argv[1] if len(sys.argv) > 1 else "lerobot061"
    if name not in ENVIRONMENTS:
        print(f"no environment {name!r}; there are {', '.join(ENVIRONMENTS)}", file=sys.stderr)
        return 2
    try:
        env = ENVIRONMENTS[name](lambda text: print(text, file=sys.stderr))
    except shell.StepFailed as error:
        print(f"the environment cannot be made: {error}", file=sys.stderr)
        return 1
    print(env.python)
    return 0


if __name__ == "__main__":
    sys.exit(main())
