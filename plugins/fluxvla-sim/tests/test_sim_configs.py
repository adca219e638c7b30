"""The repository's configurations of simulated robots."""

from __future__ import annotations

from pathlib import Path

import pytest

from fluxvla_core import build_operator_from_cfg, build_runner_from_cfg
from fluxvla_core.cli.main import main
from fluxvla_core.config.load import load_config
from fluxvla_core.spec import differences

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
NAMES = ("aloha_sim_transfer", "aloha_sim_ros2", "ur5e_sim_lift", "ur5e_sim_ros2")


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_wrong_with_it(name, capsys):
    assert main(["config", "check", str(CONFIGS / f"{name}.py")]) == 0
    assert "no problems" in capsys.readouterr().out


SAME = {
    "aloha_sim_transfer": ("AlohaSimOperator", "AlohaSimROSOperator", "AlohaOperator"),
    "aloha_sim_ros2": ("AlohaSimOperator", "AlohaSimROSOperator", "AlohaOperator"),
    "ur5e_sim_lift": ("URSimOperator", "URSimROSOperator", "UROperator"),
    "ur5e_sim_ros2": ("URSimOperator", "URSimROSOperator", "UROperator"),
}


@pytest.mark.parametrize(
    ("name", "kind"), [(name, kind) for name, kinds in SAME.items() for kind in kinds]
)
def test_the_operators_type_is_all_that_another_robot_needs(name, kind, capsys):
    config = str(CONFIGS / f"{name}.py")
    changed = ["--set", f"inference.operator.type={kind}"]
    assert main(["run", "--config", config, "--section", "inference", *changed, "--dry-run"]) == 0
    assert kind in capsys.readouterr().out

    table = load_config(config).tree["inference"]["operator"]
    own, other = (build_operator_from_cfg({**table, **type_}) for type_ in ({}, {"type": kind}))
    assert type(other).__name__ == kind
    assert differences(own.embodiment, other.embodiment) == []
    assert own.embodiment.cameras == other.embodiment.cameras


@pytest.mark.parametrize("kind", ["AlohaSimOperator", "AlohaSimROSOperator"])
@pytest.mark.parametrize(("said", "seed"), [({}, 42), ({"seed": 3}, 3)])
def test_a_simulated_scene_begins_from_the_runners_seed(kind, said, seed):
    table = load_config(CONFIGS / "aloha_sim_ros2.py").tree["inference"]
    operator = {**table["operator"], "type": kind, **said}

    runner = build_runner_from_cfg({**table, "seed": 42, "operator": operator})
    assert runner.ros_operator.seed == seed


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
