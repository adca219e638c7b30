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
    told = found["memory"]["bytes"]["2"]
    # FSDP divides gradients at the end of a step; until then a process has them whole.
    assert 0 < told["gradients"] <= 2 * told["parameters"]
    # Qwen3-VL decides by the values of its tokens where it is trained.
    assert found["memory"]["activations_known"] == (name != "gr00t_n17_libero_full")


def test_every_family_can_be_trained_in_three_ways() -> None:
    page = (CONFIGS.parent / "docs" / "training.md").read_text(encoding="utf-8")
    table = page[page.index("### Recipes") :].partition("\n## ")[0]
    said = set(re.findall(r"`(\w+)`", table))
    assert said <= set(NAMES)
    for line in table.splitlines()[4:12]:
        assert all(cell.strip() for cell in line.strip("|").split("|")), line
