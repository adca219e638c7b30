"""Every config that trains passes a dry run: its model, its adapters and its batch fit together."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from fluxvla_core.cli.main import main
from fluxvla_core.config.load import load_config

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
NAMES = sorted(p.stem for p in CONFIGS.glob("*.py") if "runner" in load_config(p).tree)
QUICK = "smolvla_libero_lora"
WRONG = re.compile(r"cannot be|is not known|have \d+ numbers|has no camera|no trainable|chunks \(")


@pytest.mark.parametrize(
    "name",
    [name if name == QUICK else pytest.param(name, marks=pytest.mark.slow) for name in NAMES],
)
def test_a_recipe_is_complete(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    for package in ("torch", "transformers", "peft"):
        pytest.importorskip(package)
    words = ["--config", str(CONFIGS / f"{name}.py"), "--section", "runner", "--dry-run"]
    assert main(["run", *words, "--nproc", "2", "--log-format", "json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert not [note for note in found["notes"] if WRONG.search(note)]
    estimate = found["memory"]["bytes"]["2"]
    # FSDP divides gradients at the end of a step; until then a process has them whole.
    assert 0 < estimate["gradients"] <= 2 * estimate["parameters"]
    # Qwen3-VL decides by the values of its tokens where it is trained.
    assert found["memory"]["activations_known"] == (name != "gr00t_n17_libero_full")


def tables() -> list[list[list[str]]]:
    """Of the page: recipes by what they train, and by robot; rows of cells."""
    page = (CONFIGS.parent / "docs" / "models.md").read_text(encoding="utf-8")
    text = page[page.index("## Training recipes") :].partition("\n## Memory")[0]
    blocks = [block.splitlines()[2:] for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)]
    return [[[c.strip() for c in row.strip("|").split("|")] for row in rows] for rows in blocks]


def test_every_family_can_be_trained_in_three_ways() -> None:
    ways, _ = tables()
    assert set(re.findall(r"`(\w+)`", str(ways))) <= set(NAMES)
    *pretrained, new = ways
    assert len(pretrained) == 9
    assert all(cell for row in pretrained for cell in row), ways
    assert new[0] == "CompactVLA, ACT, Diffusion Policy"


@pytest.mark.parametrize("row", tables()[1], ids=lambda row: row[0])
def test_every_family_has_a_config_for_every_robot(row: list[str]) -> None:
    models = set()
    for cell, robot in zip(row[1:], ("Aloha", "UR", "Libero"), strict=True):
        tree = load_config(CONFIGS / f"{cell.strip('`')}.py").tree
        models.add(tree["model"]["type"])
        assert tree["runner"]["type"]
        acting = [tree[name]["type"] for name in ("inference", "eval") if tree.get(name)]
        assert acting
        assert all(name.startswith(robot) for name in acting)
        chunk = tree["train_dataloader"]["dataset"]["action_window_size"]
        assert chunk >= 1
    assert len(models) == 1


def test_the_families_are_all_that_there_are() -> None:
    """A model that a plugin registers and a config trains has its row."""
    named = {load_config(CONFIGS / f"{name}.py").tree["model"]["type"] for name in NAMES}
    listed = {
        load_config(CONFIGS / f"{cell.strip('`')}.py").tree["model"]["type"]
        for row in tables()[1]
        for cell in row[1:]
    }
    assert named == listed
