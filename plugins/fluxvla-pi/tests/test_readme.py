"""README's commands on a tiny checkpoint, and the configs that it names."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from fluxvla_pi import lerobot_write
from fluxvla_pi.lerobot_format import LeRobotPiFormat

from fluxvla_core.cli.main import main

from .oracles import pi_inputs
from .published_folders import lerobot_folder, robot_file, tokenizer_folder

ROOT = Path(__file__).parents[3]
README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def command(start):
    """The README's command that begins so, as words."""
    lines = [line.strip() for line in README.splitlines() if line.startswith("    fluxvla ")]
    (line,) = [line for line in lines if line.startswith(f"fluxvla {start}")]
    return shlex.split(line)[1:]


def test_a_published_checkpoint_comes_in_and_goes_out(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = lerobot_folder(tmp_path / "published", "pi05")
    tokenizer_folder(tmp_path / "paligemma")
    robot_file(tmp_path / "robot.json")
    words = [str(source) if w.startswith("hf:") else w for w in command("import-checkpoint")]
    assert main(words) == 0

    model = LeRobotPiFormat().read(source).model
    sizes = {key: model[key] for key in ("variant", "expert_variant", "vision_variant")}
    monkeypatch.setattr(lerobot_write, "_VARIANTS", sizes)
    monkeypatch.setattr(lerobot_write, "VOCABULARY", pi_inputs.VOCABULARY)
    words = ["pi05" if w == "work_dirs/pi05" else w for w in command("export")]
    assert main(words) == 0
    assert LeRobotPiFormat().recognizes(tmp_path / "exported")


@pytest.mark.parametrize("name", ["pi05_aloha", "pi05_ur", "pi0_libero", "pi0_fast_libero"])
def test_its_configs_have_no_problems(name, capsys):
    assert f"configs/{name}.py" in README
    assert main(["config", "check", str(ROOT / "configs" / f"{name}.py")]) == 0
    assert "no problems" in capsys.readouterr().out
