"""Data, or weights to start from, that do not fit a family are refused before it is built."""

from __future__ import annotations

from collections.abc import Iterator
from functools import wraps
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch")
pytest.importorskip("mujoco")
pytest.importorskip("fluxvla_sim")

from fluxvla_core import VLAS
from fluxvla_core.cli.main import main
from fluxvla_core.config.load import load_config

from .tiny import tiny, write_tokenizers

WINDOW = "train_dataloader.dataset.action_window_size=5"
ONE_CAMERA = 'train_dataloader.dataset.img_keys=["top"]'
CHUNK = "the number of actions in a chunk is {}, in the data it is 5"
CAMERAS = "the number of cameras is 2, in the data it is 1"
IMAGES = "the size of images is {0} x {0}, in the data it is 28 x 28"
STATES = "the width of states is {}, in the data it is {}"
ACTIONS = "the width of actions is {}, in the data it is {}"
NUMBER = "train_dataloader.dataset.embodiment_id=99"
ROBOT = "embodiment_ids are below 32, in the data one is 99"
OBSERVATIONS = "n_obs_steps of the model is 2, that of the dataset 1"
MISFITS = [
    ("pi0", WINDOW, "model.n_action_steps: PI0FlowMatching: " + CHUNK.format(8)),
    ("pi0", "model.max_state_dim=33", "PI0FlowMatching: " + STATES.format(33, 32)),
    ("pi0", "model.vision_variant.image_size=42", "PI0FlowMatching: " + IMAGES.format(42)),
    ("pi05", WINDOW, "model.n_action_steps: PI05FlowMatching: " + CHUNK.format(8)),
    ("pi05", "model.max_action_dim=33", "PI05FlowMatching: " + ACTIONS.format(33, 32)),
    ("pi0_fast", WINDOW, "model.n_action_steps: PI0FAST: " + CHUNK.format(8)),
    ("smolvla", WINDOW, "model.n_action_steps: SmolVLA: " + CHUNK.format(8)),
    ("smolvla", "model.max_state_dim=33", "model.max_state_dim: SmolVLA: " + STATES.format(33, 32)),
    ("gr00t_n15", WINDOW, "model.vla_head.horizon: GR00T: " + CHUNK.format(8)),
    ("gr00t_n15", "model.vla_head.state_dim=65", "GR00T: " + STATES.format(65, 64)),
    ("gr00t_n15", "model.vlm_backbone.image_size=42", "GR00T: " + IMAGES.format(42)),
    ("gr00t_n15", NUMBER, ROBOT),
    ("gr00t_n17", WINDOW, "model.vla_head.horizon: GR00T: " + CHUNK.format(8)),
    ("gr00t_n17", NUMBER, ROBOT),
    ("openvla", WINDOW, "model: OpenVLA: " + CHUNK.format(1)),
    ("openvla", "model.action_dim=7", "model.action_dim: OpenVLA: " + ACTIONS.format(7, 14)),
    ("openvla_oft", WINDOW, "model.horizon: OpenVLAOFT: " + CHUNK.format(8)),
    ("openvla_oft", ONE_CAMERA, "model.num_images: OpenVLAOFT: " + CAMERAS),
    ("openvla_oft", "model.state_dim=7", "model.state_dim: OpenVLAOFT: " + STATES.format(7, 14)),
    ("openvla_oft", "model.image_size=42", "model.image_size: OpenVLAOFT: " + IMAGES.format(42)),
    ("llava", WINDOW, "model.vla_head.horizon: LlavaVLA: " + CHUNK.format(8)),
    ("llava", ONE_CAMERA, "model.vision_backbone.num_cameras: LlavaVLA: " + CAMERAS),
    ("llava", "model.vision_backbone.sizes.image_size=42", "LlavaVLA: " + IMAGES.format(42)),
    ("compact", ONE_CAMERA, "model.vision_backbone.num_cameras: CompactVLA: " + CAMERAS),
    ("act", ONE_CAMERA, "act.py:1: model.num_cameras: ACT: " + CAMERAS),
    ("act", WINDOW, "model.horizon: ACT: " + CHUNK.format(8)),
    ("act", "model.state_dim=7", "model.state_dim: ACT: " + STATES.format(7, 14)),
    ("diffusion", ONE_CAMERA, "model.num_cameras: DiffusionPolicy: " + CAMERAS),
    ("diffusion", "model.action_dim=7", "DiffusionPolicy: " + ACTIONS.format(7, 14)),
    ("diffusion", "train_dataloader.dataset.n_obs_steps=1", OBSERVATIONS),
]  # fmt: skip


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Gets a config; the list that it returns then has the models of that class that are built."""

    def watch(config: Path) -> list[str]:
        cls = VLAS.get(load_config(config).tree["model"]["type"])
        calls: list[str] = []
        init = cls.__dict__["__init__"]

        @wraps(init)
        def count(self: Any, *arguments: Any, **keywords: Any) -> None:
            calls.append(cls.__name__)
            init(self, *arguments, **keywords)

        monkeypatch.setattr(cls, "__init__", count)
        return calls

    return watch


@pytest.mark.parametrize(("family", "change", "words"), MISFITS)
def test_data_that_do_not_fit(
    family: str,
    change: str,
    words: str,
    data: Path,
    tmp_path: Path,
    built: Any,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = tiny(family, tmp_path, data)
    calls = built(config)
    for said in refused(config, tmp_path / "work", capsys, "--set", change):
        assert words in said
    assert not calls


def refused(
    config: Path, work: Path, capsys: pytest.CaptureFixture[str], *words: str
) -> Iterator[str]:
    """What a training and a dry run say, which end with exit code 2 and leave no work dir."""
    for more in (["--work-dir", str(work)], ["--dry-run"]):
        assert main(["run", "--config", str(config), "--section", "runner", *words, *more]) == 2
        yield capsys.readouterr().err
    assert not work.exists()


def test_a_prompt_for_other_cameras(
    data: Path, tmp_path: Path, built: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tiny("gr00t_n15", tmp_path, data)
    calls = built(config)
    command = ["run", "--config", str(config), "--section", "runner", "--set", ONE_CAMERA]
    assert main([*command, "--work-dir", str(tmp_path / "work")]) == 2
    assert "num_images is 2, the sample has 1 images" in capsys.readouterr().err
    assert not calls


TOKENS = "ids of tokens are below {}, in the data they go up to {}"
TOKENIZERS = [
    ("pi0", "model.vocab_size: PI0FlowMatching: ", (264, 2257)),
    ("pi05", "model.vocab_size: PI05FlowMatching: ", (264, 2257)),
    ("pi0_fast", "model.vocab_size: PI0FAST: ", (1024, 2257)),
    ("smolvla", "model.text.vocabulary: SmolVLA: ", (264, 2257)),
    ("gr00t_n15", "model.vlm_backbone.vocabulary: GR00T: ", (264, 2260)),
    ("gr00t_n17", "model.vlm_backbone.vocabulary: GR00T: ", (264, 2263)),
    ("openvla", "model.language.vocab_size: OpenVLA: ", (416, 2002)),
    ("openvla_oft", "model.language.vocab_size: OpenVLAOFT: ", (416, 2002)),
    ("llava", "model.llm_backbone.sizes.vocab_size: LlavaVLA: ", (264, 2257)),
]
"""The largest id is that of the last word, or of a mark behind it: an image's, or padding."""


@pytest.mark.parametrize(("family", "key", "ids"), TOKENIZERS)
def test_a_tokenizer_of_more_words_than_the_model_embeds(
    family: str,
    key: str,
    ids: tuple[int, int],
    data: Path,
    tmp_path: Path,
    built: Any,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = tiny(family, tmp_path, data)
    write_tokenizers(tmp_path, family, more=2000)
    calls = built(config)
    for said in refused(config, tmp_path / "work", capsys):
        assert f"{family}.py:1: {key}{TOKENS.format(*ids)}" in said
    assert not calls


def test_a_tokenizer_that_is_elsewhere_is_not_compared(data: Path, tmp_path: Path) -> None:
    """Another one stands in, whose ids mean nothing."""
    config = tiny("pi0", tmp_path, data)
    (tmp_path / "words" / "tokenizer.json").unlink()
    assert main(["run", "--config", str(config), "--section", "runner", "--dry-run"]) == 0


@pytest.fixture
def process_ends() -> Iterator[None]:
    """As a command's own process does, which takes its process group with it."""
    yield
    import torch.distributed

    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


@pytest.mark.timeout(300)
@pytest.mark.usefixtures("process_ends")
def test_weights_of_another_family(
    data: Path, tmp_path: Path, built: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("act", "diffusion"):
        (tmp_path / name).mkdir()
    other = tiny("act", tmp_path / "act", data)
    command = ["run", "--section", "runner", "--set", "runner.max_steps=2"]
    assert main([*command, "--config", str(other), "--work-dir", str(tmp_path / "other")]) == 0
    config = tiny("diffusion", tmp_path / "diffusion", data)
    calls = built(config)
    command = ["run", "--config", str(config), "--section", "runner"]
    for key in ("runner.init_from", "model.pretrained_name_or_path"):
        for more in (["--work-dir", str(tmp_path / "work")], ["--dry-run"]):
            assert main([*command, *more, "--set", f"{key}={tmp_path / 'other'}"]) == 2
            said = capsys.readouterr().err
            assert "the checkpoint is of ACT, the config's model is DiffusionPolicy" in said
    assert not calls
    assert not (tmp_path / "work").exists()


def test_all_that_does_not_fit_is_listed_at_once(
    data: Path, tmp_path: Path, built: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tiny("act", tmp_path, data)
    calls = built(config)
    changes = [word for change in (WINDOW, ONE_CAMERA) for word in ("--set", change)]
    assert main(["run", "--config", str(config), "--section", "runner", "--dry-run", *changes]) == 2
    said = capsys.readouterr().err
    assert not calls
    assert "2 problems in the config" in said
    assert CAMERAS in said
    assert CHUNK.format(8) in said


HELD_OUT = [
    ("act", {"img_keys": ["top"]}, "act.py:1: model.num_cameras: ACT: the number of cameras is 2, "
     "in the validation data it is 1"),
    ("diffusion", {"n_obs_steps": 1}, "diffusion.py:6: val_dataloader.dataset.n_obs_steps: "
     f"{OBSERVATIONS}"),
    ("gr00t_n17", {"embodiment_id": 99}, "GR00T: embodiment_ids are below 32, in the validation "
     "data one is 99"),
]  # fmt: skip


@pytest.mark.parametrize(("family", "change", "words"), HELD_OUT)
def test_validation_data_that_do_not_fit(
    family: str,
    change: dict[str, Any],
    words: str,
    data: Path,
    tmp_path: Path,
    built: Any,
    capsys: pytest.CaptureFixture[str],
) -> None:
    config = tiny(family, tmp_path, data)
    table = load_config(config).tree["train_dataloader"]["dataset"]
    with config.open("a") as file:
        file.write(f"val_dataloader = {{'dataset': { ({**table, **change})!r}}}\n")
    calls = built(config)
    command = ["run", "--config", str(config), "--section", "runner", "--set", WINDOW]
    for more in (["--work-dir", str(tmp_path / "work")], ["--dry-run"]):
        assert main([*command, *more]) == 2
        said = capsys.readouterr().err
        assert words in said
        assert CHUNK.format(8) in said
        assert "2 problems in the config" in said
    assert not calls
    assert not (tmp_path / "work").exists()


def test_images_that_no_transform_normalises(
    data: Path, tmp_path: Path, built: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tiny("act", tmp_path, data)
    tree = load_config(config).tree
    table = tree["train_dataloader"]["dataset"]
    kept = [t for t in table["transforms"] if not t["type"].startswith("NormalizeImages")]
    assert len(kept) < len(table["transforms"])
    table["transforms"] = kept
    config.write_text("".join(f"{name} = {value!r}\n" for name, value in tree.items()))
    calls = built(config)
    assert main(["run", "--config", str(config), "--section", "runner", "--dry-run"]) == 2
    said = capsys.readouterr().err
    assert not calls
    assert "ACT: images are normalised floats, in the data they are uint8" in said
