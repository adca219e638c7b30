"""``fluxvla run --dry-run`` of a training: shapes from the data to the robot, and memory."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fluxvla_core.cli.main import main
from fluxvla_core.data import LeRobotWriter
from fluxvla_core.plugins.registry import VLAS
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

torch = pytest.importorskip("torch")

ARM = EmbodimentSpec(
    "arm",
    tuple(Joint(n, "rad", -1.0, 1.0, 1.0, 1.0) for n in "abc"),
    (Camera("front", 32, 48),),
    10.0,
)
# Encoder, two blocks, head; the encoder is frozen.
WEIGHTS, TRAINED = (3 * 8 + 8) + 2 * (8 * 8 + 8) + (8 * 12 + 12), 2 * (8 * 8 + 8) + (8 * 12 + 12)


class DryVLA(torch.nn.Module):
    """States to chunks of four actions of three joints."""

    action_shape = (4, 3)

    def __init__(self, mood: str = "", state_dim: int = 3, path: str | None = None) -> None:
        super().__init__()
        self.encoder = torch.nn.Linear(state_dim, 8).requires_grad_(False)
        self.blocks = torch.nn.ModuleList(torch.nn.Linear(8, 8) for _ in range(2))
        self.head = torch.nn.Linear(8, 12)
        self.mood = mood
        if mood == "looks at weights":
            float(self.head.weight.sum())

    def fsdp_units(self) -> list[Any]:
        return list(self.blocks)

    def forward(self, images: Any, states: Any, actions: Any, action_masks: Any) -> dict[str, Any]:
        if self.mood == "looks at inputs" and float(states.sum()) > 0:
            states = -states
        x = self.encoder(states)
        for block in self.blocks:
            x = block(x).relu()
        errors = self.head(x).unflatten(1, (4, 3)) - actions
        return {"loss": errors.square().mean() + 0 * images.mean()}


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    VLAS.register_module()(DryVLA)
    yield
    VLAS.unregister("DryVLA")


def written(folder: Path, runner: str = "type='FSDPTrainRunner'", model: str = "") -> list[str]:
    (folder / "c.py").write_text(
        f"""
model = dict(type='DryVLA'{model})
train_dataloader = dict(per_device_batch_size=5, dataset=dict(
    type='ParquetDataset', data_root_path={str(folder / "data")!r}, img_keys=['front'],
    action_window_size=4, transforms=[
        dict(type='ResizeImages', height=16, width=24),
        dict(type='NormalizeImages', means=[[127.5] * 3], stds=[[127.5] * 3]),
        dict(type='NormalizeStatesAndActions', state_key='proprio', action_key='action',
             norm_type='mean_std'),
    ]))
runner = dict({runner}, max_steps=2, learning_rate=1e-3, collator=dict(type='DictCollator',
    keys=['images', 'states', 'actions', 'action_masks', 'sample_ids'],
    meta_keys=['img_masks', 'task_description', 'info', 'timestamp']))
"""
    )
    return ["run", "--config", str(folder / "c.py"), "--section", "runner", "--dry-run"]


def recorded(folder: Path) -> None:
    with LeRobotWriter(folder / "data", 10, ARM) as writer:
        for _ in range(6):
            image = np.zeros((32, 48, 3), np.uint8)
            writer.add_frame({"front": image}, np.zeros(3), np.ones(3), "wave")
        writer.save_episode()


def outline(words: list[str], capsys: pytest.CaptureFixture[str]) -> Any:
    assert main([*words, "--log-format", "json"]) == 0
    return json.loads(capsys.readouterr().out)


def shown(words: list[str], capsys: pytest.CaptureFixture[str]) -> list[str]:
    """The lines behind the config."""
    assert main(words) == 0
    lines = capsys.readouterr().out.splitlines()
    return lines[lines.index("pipeline:") :]


def test_a_table_of_memory_that_fits_a_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    lines = shown(written(tmp_path), capsys)
    # A path is not broken; it is to be copied.
    assert [line for line in lines if len(line) > 80 and str(tmp_path) not in line] == []
    text = "\n".join(lines)
    assert f"DryVLA: {WEIGHTS} parameters, {TRAINED} trained ({TRAINED / WEIGHTS:.1%})" in text
    assert "chunks of 4 actions, 3 wide" in text
    assert "images (5, 3, 16, 24) float32" in text
    assert "images are assumed to be 480 x 640" in text
    assert "memory of each process in GB (1e9 bytes), computing in float32:" in text
    (head,) = (line.split() for line in lines if line.startswith("  processes"))
    assert head == ["processes", "1", "2", "4", "8"]
    assert [line for line in lines if line.startswith("  one process")]
    assert "Not counted: fragmentation" in text
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.py"]


def test_the_same_for_machines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = outline([*written(tmp_path, "type='DDPTrainRunner'"), "--nproc", "3"], capsys)
    assert list(found["memory"]["bytes"]) == ["3"]
    told = found["memory"]["bytes"]["3"]
    assert (told["parameters"], told["gradients"]) == (4 * WEIGHTS, 4 * TRAINED)
    # Two means, and a count of steps for each of six tensors.
    assert told["optimizer"] == 2 * 4 * TRAINED + 6 * 4
    assert told["batch"] == 4 * 5 * (3 * 16 * 24 + 3 + 4 * 3 + 4)
    assert told["activations"] > 0
    assert told["total"] == sum(v for k, v in told.items() if k != "total")
    assert found["memory"]["activations_known"]
    assert found["memory"]["left_out"]
    assert found["pipeline"]["model"]["parameters"] == WEIGHTS
    assert found["pipeline"]["batch"]["actions"] == {"shape": [5, 4, 3], "dtype": "float32"}
    assert found["pipeline"]["dataset"]["samples"] is None


def test_shapes_of_a_dataset_that_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded(tmp_path)
    words = written(tmp_path)
    found = outline(words, capsys)
    assert found["pipeline"]["dataset"] == {
        "samples": 6,
        "states": 3,
        "actions": 3,
        "cameras": {"front": [32, 48]},
    }
    assert found["notes"] == []
    text = "\n".join(shown(words, capsys))
    assert "dataset  6 samples at 10 Hz, 1 tasks, statistics 'private'" in text
    assert "cameras  front 32x48" in text


@pytest.mark.parametrize(
    ("model", "runner", "said"),
    [
        (", mood='looks at weights'", "", "the model cannot be built on the meta device: "),
        (", mood='looks at inputs'", "", "activations are not known: DataDependentOutput"),
        (", state_dim=4", "", "activations are not known: "),
        ("", ", lora=dict(rank=2, target_modules=['nowhere'])", "adapters cannot be put into"),
        ("", ", grad_accumulation_steps=0", "the runner cannot be built: "),
    ],
)
def test_what_cannot_be_known_is_one_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], model: str, runner: str, said: str
) -> None:
    recorded(tmp_path)
    found = outline(written(tmp_path, f"type='FSDPTrainRunner'{runner}", model), capsys)
    (note,) = found["notes"]
    assert note.startswith(said)
    assert "\n" not in note
    told = found["memory"]["bytes"]
    if said.startswith("activations"):
        assert told["1"]["parameters"] > 0
        assert told["1"]["activations"] == 0
    else:
        assert not told


def test_adapters_freeze_the_rest(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("peft")
    lora = "type='DDPTrainRunner', lora=dict(rank=2, target_modules=['blocks.0', 'blocks.1'])"
    found = outline(written(tmp_path, lora), capsys)
    added = 2 * 2 * (8 + 8)
    told = found["pipeline"]["model"]
    assert (told["trained"], told["parameters"]) == (added, WEIGHTS)
    assert found["memory"]["bytes"]["1"]["gradients"] == 4 * added
    assert found["memory"]["bytes"]["1"]["parameters"] == 4 * (WEIGHTS + added)


def test_data_of_another_robot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recorded(tmp_path)
    words = written(tmp_path)
    with (tmp_path / "c.py").open("a") as file:
        file.write("inference = dict(type='AlohaInferenceRunner', operator=dict(\n")
        file.write("    type='AlohaSimOperator', camera_names=('top',)))\n")
    pytest.importorskip("fluxvla_aloha")
    pytest.importorskip("fluxvla_sim")
    found = outline(words, capsys)
    assert found["pipeline"]["robot"]["name"] == "aloha"
    assert found["notes"] == [
        "the dataset's states have 3 numbers, those of aloha 14",
        "the dataset's actions have 3 numbers, those of aloha 14",
        "aloha has no camera front",
    ]


@pytest.mark.parametrize("log_format", ["text", "json"])
def test_a_batch_that_the_model_does_not_take_ends_it(
    log_format: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = written(tmp_path)
    config = tmp_path / "c.py"
    config.write_text(config.read_text().replace("keys=['images',", "keys=['img_masks', 'images',"))
    assert main([*words, "--log-format", log_format]) == 2
    told = capsys.readouterr()
    assert "img_masks" in told.out  # the batch is shown
    assert "c.py:" in told.err
    assert "runner.collator: DryVLA.forward takes no 'img_masks'" in told.err
    assert "move what only describes from the collator's keys to meta_keys" in told.err


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("norm_type='mean_std'", "norm_type='quantil'", "did you mean 'quantile'?"),
        ("norm_type='mean_std'", "action_dim=2", "action_dim 2 would cut the data's 3 dimensions"),
        ("img_keys=['front']", "img_keys=['front', 'top']", "there is no camera 'top'"),
        ("img_keys=['front']", "img_keys=[]", "ResizeImages needs 'images'; the sample has"),
    ],
)
def test_data_that_the_training_would_refuse_ends_it(
    old: str, new: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where the dataset is here; where it is not, its shapes are assumed, and it is a note."""
    words = written(tmp_path)
    config = tmp_path / "c.py"
    config.write_text(config.read_text().replace(old, new))
    assert main(words) == 0
    recorded(tmp_path)
    capsys.readouterr()
    assert main(words) == 2
    told = capsys.readouterr().err
    assert re.search(r"c\.py:\d+: train_dataloader\.dataset: ", told)
    assert said in told
    if "--set" in told:
        assert "--set train_dataloader.dataset.transforms.2.action_dim=3" in told
