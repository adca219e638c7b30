"""Next steps with a demo's results: commands with its own paths, which CI runs in short forms."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from tools import rendering
from tools.demo import stages
from tools.demo.sizes import SIZES, Size
from tools.demo.stages import CONFIG, Places
from tools.envs import Env

ROS2_CONFIG = CONFIG.with_name("aloha_sim_ros2.py")
OTHER_TASK = "hand the cube over to the left arm"
OTHER_SEED = 2000
# The robot of the ROS 2 command, in a second terminal.
ROBOT = "fluxvla sim aloha --ros2 --cameras top --height 144 --width 192"


@dataclass(frozen=True)
class Next:
    """One command, and what makes it short for a test; None: a test runs it elsewhere.

    Args:
        title: what it is for.
        command: program and arguments, as a user types them.
        short: further arguments of the short form.
    """

    title: str
    command: tuple[str, ...]
    short: tuple[str, ...] | None = ()

    @property
    def line(self) -> str:
        return shlex.join(self.command)


def next_steps(size: Size, places: Places, steps: int) -> list[Next]:
    """The commands, for a demo that trained for ``steps``."""
    work = str(places.work)
    run = ("fluxvla", "run", "--config", str(CONFIG), "--section")
    again = ("--work-dir", str(places.root / "again"), "--set", f"eval.ckpt_path={work}")
    robot = ("fluxvla", "run", "--config", str(ROS2_CONFIG), "--section", "inference")
    return [
        Next("look", ("python", "-m", "webbrowser", places.report.resolve().as_uri())),
        Next(
            "evaluate again",
            (*run, "eval", *again, "--set", f"eval.seed={OTHER_SEED}"),
            _set("eval.episodes=1", "eval.baseline=false", "eval.instruction_swap=false"),
        ),
        Next(
            "other instruction",
            (*run, "inference", "--work-dir", work, "--task", OTHER_TASK),
            _set("inference.max_publish_step=20"),
        ),
        Next("drive by ROS 2", (*robot, "--work-dir", work, "--task", "1"), None),
        Next(
            "go on training",
            (*stages.train(size, places, 2 * steps).command, "--resume", "auto"),
            _set(f"runner.max_steps={steps + 1}"),
        ),
    ]


def listing(steps: list[Next]) -> list[str]:
    """The lines that end a demo."""
    width = max(len(step.title) for step in steps)
    lines = []
    for step in steps:
        lines.append(f"  {step.title:{width}}  {step.line}")
        if step.command[3:4] == (str(ROS2_CONFIG),):
            lines.append(f"  {'':{width}}  at the same time: {ROBOT}  (docs/ros2.md)")
    return lines


def check(env: Env, root: Path, out: Path) -> None:
    """Run what the short demo in ``out`` named, in short forms; raises StepFailed."""
    size = SIZES["smoke"]
    # No window is opened: this browser takes the address and is content.
    variables = {**rendering.VARIABLES, "BROWSER": "true"}
    for step in next_steps(size, Places(out / size.name), size.steps):
        if step.short is None:
            words = ("config", "check", step.command[3])
            env.run("fluxvla", *words, cwd=root, env=variables, quiet=True)
        else:
            env.run(*step.command, *step.short, cwd=root, env=variables)


def _set(*overrides: str) -> tuple[str, ...]:
    return tuple(word for override in overrides for word in ("--set", override))
