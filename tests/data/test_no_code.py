"""Weights, datasets and processors are data: nothing that loads them may run code of theirs."""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from fluxvla_core.data.pretrained import model_folder
from fluxvla_core.errors import ConfigError

ROOT = Path(__file__).parents[2]
PARTS = ("src", "plugins", "examples", "benchmarks", "tools", "configs")
NEVER = {
    *("pickle.load", "pickle.loads", "torch.load", "torch.hub.load", "joblib.load", "dill.load"),
    *("yaml.load", "yaml.unsafe_load", "runpy.run_path", "snapshot_download"),
}


# Only where somebody named a model of the hub, for files that are read as data.
HUB = (ROOT / "src/fluxvla_core/checkpoints/foreign.py", "snapshot_download")


def calls(path: Path) -> Iterator[tuple[str, ast.Call]]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


def flaws(path: Path) -> Iterator[str]:
    for name, call in calls(path):
        said = {word.arg: ast.unparse(word.value) for word in call.keywords}
        place = f"{path}:{call.lineno}: {name}"
        # transformers asks 'run the custom code? [y/N]' by default.
        if name.endswith(".from_pretrained") and not name.startswith("Peft"):
            if said.get("trust_remote_code") != "False":
                yield f"{place} without trust_remote_code=False"
        elif "trust_remote_code" in said and said["trust_remote_code"] != "False":
            yield place
        if name == "torch.load" and said.get("weights_only") == "True":
            continue  # tensors and plain containers alone
        if ((path, name) != HUB and name in NEVER) or said.get("allow_pickle") == "True":
            yield place


def test_nothing_that_is_loaded_may_bring_code() -> None:
    found = [path for part in PARTS for path in sorted((ROOT / part).rglob("*.py"))]
    # Programs of other implementations, in environments of their own; and the plugin in which
    # LeRobot loads its own files: what would run code is refused before, as its tests show.
    files = [p for p in found if "oracles" not in p.parts and "fluxvla-lerobot" not in p.parts]
    assert len(files) > 200
    assert [flaw for path in files for flaw in flaws(path)] == []


def test_what_may_bring_code_is_found(tmp_path: Path) -> None:
    module = tmp_path / "m.py"
    module.write_text(
        "A.from_pretrained('x')\nA.from_pretrained('x', trust_remote_code=True)\n"
        "A.from_pretrained('x', trust_remote_code=False)\ntorch.load('x')\n"
        "np.load('x', allow_pickle=True)\nB(trust_remote_code=asked)\n"
        "torch.load('x', weights_only=True)\ntorch.load('x', weights_only=asked)\n"
        "snapshot_download('x')\n"
    )
    assert [int(flaw.split(":")[1]) for flaw in flaws(module)] == [1, 2, 4, 5, 6, 8, 9]


def test_a_model_that_wants_its_code_run_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "config.json"
    file.write_text(json.dumps({"model_type": "x", "auto_map": {"AutoModel": "evil.Evil"}}))
    with pytest.raises(ConfigError, match="auto_map"):
        model_folder(tmp_path)
    file.write_text(json.dumps({"model_type": "bert"}))
    (tmp_path / "data_config.json").write_text("[]")  # as sentence-transformers has it
    assert model_folder(tmp_path) == tmp_path
    (tmp_path / "adapter_config.json").write_text('{"base_model_name_or_path": "/elsewhere"}')
    with pytest.raises(ConfigError, match="another folder"):
        model_folder(tmp_path)
    (tmp_path / "adapter_config.json").unlink()
    file.write_text("[" * 100_000)
    with pytest.raises(ConfigError, match=r"config\.json"):
        model_folder(tmp_path)
