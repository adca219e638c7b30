"""LeRobot in an environment of its own, to ask it whether it reads what we write and the reverse.

LeRobot cannot share an environment with this project: it wants an older torch, its torchvision and
its PyAV. Here it gets the torch of ``constraints.txt`` all the same, which its datasets and
policies work with: torchvision's compiled part cannot be loaded with a CPU build of torch, and
nothing here calls it; torchcodec uses the FFmpeg that PyAV's wheel brings, so nothing has to be
installed into the system.

    python -m tools.lerobot_env          prints the environment's Python
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from tools import project, shell, torch_build
from tools.envs import Env

LEROBOT = ("lerobot==0.4.4", "torchcodec==0.13.0", "torchvision==0.28.0")
# What LeRobot's datasets and its commands import, in the versions that go with 0.4.4.
NEEDS = (
    "accelerate",
    "av<16",
    "datasets>=4.8,<5",
    "deepdiff",
    "diffusers",
    "draccus==0.10.0",
    "einops",
    "gymnasium",
    "huggingface-hub<2",
    "imageio",
    "jsonlines",
    "opencv-python-headless",
    "packaging<26",
    "pandas<3",
    "pyarrow<30",
    "pyserial",
    "safetensors",
    "termcolor",
)
TRY_CODEC = """
try:
    import torchcodec
except Exception as error:
    missing = [line.strip() for line in str(error).splitlines() if "libpython" in line]
    raise SystemExit(missing[0] if missing else f"torchcodec: {error}")
"""
# With a torch for which torchvision's library is not built, its import stops at these operators.
DECLARED = """
# Added by tools/lerobot_env.py
if not _has_ops():
    _declared = torch.library.Library("torchvision", "DEF")
    _declared.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    _declared.define("qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
"""
FFMPEG = ("avcodec", "avdevice", "avfilter", "avformat", "avutil", "swresample", "swscale")


class LeRobotEnv(Env):
    """The environment; ``variables`` lets torchcodec find FFmpeg and keeps LeRobot off the net."""

    @property
    def ffmpeg(self) -> Path:
        return self.root / "ffmpeg"

    def create(self) -> None:
        """Make it again with ``venv``: pytest's environment has no virtualenv."""
        shell.run([sys.executable, "-m", "venv", "--clear", self.root], quiet=True, echo=False)

    def variables(self) -> dict[str, str]:
        return {
            **super().variables(),
            "LD_LIBRARY_PATH": str(self.ffmpeg),
            "HF_HUB_OFFLINE": "1",
            "HF_HOME": str(self.root / "hf"),
            "SVT_LOG": "1",
        }


def prepare(
    log: Callable[[str], None],
    root: Path = project.ROOT / ".nox" / "lerobot",
    more: Sequence[str] = (),
) -> Env:
    """Install what is missing, and ``more``; about a minute the first time.

    Raises:
        StepFailed: it cannot be installed.
    """
    env = LeRobotEnv(root)
    version = project.constrained_version("torch")
    needs = (*NEEDS, *more)
    base = {"python": sys.version, "torch": version, "needs": " ".join(needs)}

    def install_base() -> None:
        # No constraints: they are this project's, and LeRobot's needs are others.
        torch_build.install(env, version, None, log)
        env.pip_install(*needs, quiet=True)

    def install_parts(changed: list[str], fresh: bool) -> None:
        env.pip_install("--no-deps", *LEROBOT, quiet=True)
        declare_operators(env)
        remove_tests(env)
        _link_ffmpeg(env)
        # Some Pythons (Debian's, unless libpython3.x is installed) lack the library it links to.
        env.run("python", "-c", TRY_CODEC, quiet=True, echo=False)

    env.filled(base, {"lerobot": " ".join(LEROBOT) + DECLARED}, install_base, install_parts)
    return env


def declare_operators(env: Env) -> None:
    """Let torchvision's names be imported where its compiled part cannot be; done again, no more.

    Raises:
        ValueError: torchvision is not there.
    """
    (module,) = env.root.glob("lib/python*/site-packages/torchvision/extension.py")
    own = module.read_text(encoding="utf-8").partition(DECLARED.splitlines()[1])[0].rstrip()
    module.write_text(f"{own}\n{DECLARED}", encoding="utf-8")


def remove_tests(env: Env) -> None:
    """Remove the package ``tests`` that draccus installs: it would hide this repository's."""
    for package in env.root.glob("lib/python*/site-packages/tests"):
        shutil.rmtree(package)


def _link_ffmpeg(env: LeRobotEnv) -> None:
    """Give PyAV's FFmpeg libraries the names that torchcodec asks for, in addition to their own."""
    env.ffmpeg.mkdir(exist_ok=True)
    for library in env.root.glob("lib/python*/site-packages/av.libs/*.so*"):
        stem, _, rest = library.name.partition("-")
        names = [library.name]
        if stem.removeprefix("lib") in FFMPEG:
            major = rest.partition(".so.")[2].partition(".")[0]
            names.append(f"{stem}.so.{major}")
        for name in names:
            link = env.ffmpeg / name
            link.unlink(missing_ok=True)
            link.symlink_to(library)


def main() -> int:
    try:
        env = prepare(lambda text: print(text, file=sys.stderr))
    except shell.StepFailed as error:
        print(f"LeRobot cannot be installed: {error}", file=sys.stderr)
        return 1
    print(env.python)
    return 0


if __name__ == "__main__":
    sys.exit(main())
