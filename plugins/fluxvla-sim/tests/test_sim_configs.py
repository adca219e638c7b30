"""The repository's configurations of simulated robots."""

from __future__ import annotations

from pathlib import Path

import pytest

from fluxvla_core.cli.main import main
from fluxvla_core.config.load import load_config

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
NAMES = ("aloha_sim_transfer", "aloha_sim_ros2", "ur5e_sim_lift", "ur5e_sim_ros2")


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_wrong_with_it(name, capsys):
    assert main(["config", "check", str(CONFIGS / f"{name}.py")]) == 0
    assert "no problems" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("simulated", "over_ros"),
    [("aloha_sim_transfer", "aloha_sim_ros2"), ("ur5e_sim_lift", "ur5e_sim_ros2")],
)
def test_another_robot_is_another_operator_and_nothing_else(simulated, over_ros):
    one, other = (load_config(CONFIGS / f"{name}.py").tree for name in (simulated, over_ros))
    assert {k: v for k, v in one.items() if k not in ("inference", "eval")} == {
        k: v for k, v in other.items() if k not in ("inference", "eval")
    }
    same = {k for k in one["inference"] if one["inference"][k] == other["inference"][k]}
    assert set(other["inference"]) - same == {"operator", "max_publish_step"}
