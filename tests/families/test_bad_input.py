"""Input that does not fit a family: observations, and checkpoints, whose weights are not read."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from copy import deepcopy
from functools import cached_property, wraps
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("mujoco")
pytest.importorskip("fluxvla_sim")

from fluxvla_core import VLAS, build_dataset_from_cfg
from fluxvla_core.checkpoints.writer import CheckpointWriter
from fluxvla_core.config.load import FORMAT, load_config
from fluxvla_core.contracts.training import Dataset
from fluxvla_core.data import PrivateInferenceDataset
from fluxvla_core.errors import CheckpointError, FluxError
from fluxvla_core.policies.loading import load_policy
from fluxvla_core.training.fit_checks import check_family

from .tiny import CAMERAS, HEIGHT, JOINTS, SHIPPED, WIDTH, tiny, write_tokenizers

CONFIG, STATISTICS = "config.resolved.json", "dataset_statistics.json"
EMBODIMENT, POLICY = "embodiment.json", "policy.json"
Files = dict[str, Any]


class Trained:
    """What the training of a family leaves in a checkpoint, but for the weights."""

    def __init__(self, config: Path) -> None:
        self.tree = load_config(config).tree
        self.table = self.tree["train_dataloader"]["dataset"]

    @cached_property
    def dataset(self) -> Dataset:
        return Dataset.adapt(build_dataset_from_cfg(self.table))

    @cached_property
    def prepare(self) -> PrivateInferenceDataset:
        names = ("img_keys", "transforms", "embodiment_id", "statistic_name")
        given = {name: self.table[name] for name in names if name in self.table}
        return PrivateInferenceDataset(**given, norm_stats=self.dataset.statistics)

    @property
    def prompt(self) -> Mapping[str, Any] | None:
        """The transform that makes tokens of the instruction."""
        found = (
            t for t in self.table["transforms"] if "tokenizer" in t and "Action" not in t["type"]
        )
        return next(found, None)

    @property
    def entry(self) -> str:
        (name,) = self.dataset.statistics
        return name

    def save(self, folder: Path, change: Callable[[Files, str], object] | None = None) -> Path:
        robot = self.dataset.embodiment
        assert robot is not None
        horizon = self.dataset.action_window_size
        files: Files = {
            CONFIG: {"format": FORMAT, "config": self.tree, "origins": {}},
            STATISTICS: self.dataset.statistics,
            EMBODIMENT: robot.to_dict(),
            POLICY: {"action_rate_hz": self.dataset.fps, "horizon": horizon},
        }
        files = deepcopy(files)
        if change is not None:
            change(files, self.entry)
        with CheckpointWriter(folder, 1, 0) as writer:
            for name, content in files.items():
                writer.write_json(name, content)
            return writer.commit()


@pytest.fixture(scope="module")
def trained(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Trained]:
    known: dict[str, Trained] = {}

    def find(family: str) -> Trained:
        if family not in known:
            known[family] = Trained(tiny(family, tmp_path_factory.mktemp(family), data))
        return known[family]

    return find


# -- observations ----------------------------------------------------------------------------------


def observation() -> dict[str, Any]:
    return {
        "qpos": np.zeros(JOINTS, np.float32),
        "images": {camera: np.zeros((HEIGHT, WIDTH, 3), np.uint8) for camera in CAMERAS},
        "task_description": "pick up the cube",
    }


def of_image(image: Any) -> Callable[[dict[str, Any]], object]:
    return lambda seen: seen["images"].update({CAMERAS[0]: image})


UINT8 = r"uint8 of shape \(height, width, 3\) is expected"
OBSERVATIONS: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "a camera is missing": (
        lambda seen: seen["images"].pop("top"),
        "no image of camera 'top'; it has angle",
    ),
    "floats": (
        of_image(np.zeros((HEIGHT, WIDTH, 3), np.float32)),
        rf"camera 'top' gives float32 of shape \(36, 48, 3\); {UINT8}",
    ),
    "an alpha channel": (of_image(np.zeros((HEIGHT, WIDTH, 4), np.uint8)), rf"48, 4\); {UINT8}"),
    "planes first": (of_image(np.zeros((3, HEIGHT, WIDTH), np.uint8)), rf"\(3, 36, 48\); {UINT8}"),
    "no pixels": (of_image(np.zeros((0, WIDTH, 3), np.uint8)), rf"\(0, 48, 3\); {UINT8}"),
    "no number": (
        lambda seen: seen["qpos"].__setitem__(3, np.nan),
        "'qpos' must be one row of finite numbers",
    ),
    "13 joints": (
        lambda seen: seen.update(qpos=np.zeros(13, np.float32)),
        r"have shape \(13,\), the statistics .*\b14\b",
    ),
    "no instruction": (lambda seen: seen.pop("task_description"), "there is no instruction"),
    "a long instruction": (
        lambda seen: seen.update(task_description="pick up the cube and " * 80),
        r"and pick.* has \d+ tokens.*max_len is {max_len}$",
    ),
}  # fmt: skip
UNSEEN = {"openvla": ("13 joints",), "act": ("no instruction", "a long instruction")}
"""Models that are not shown the state, or the instruction."""
UNSEEN["diffusion"] = UNSEEN["act"]


@pytest.mark.parametrize(
    ("family", "what"),
    [(f, what) for f in SHIPPED for what in OBSERVATIONS if what not in UNSEEN.get(f, ())],
)
def test_observations(family: str, what: str, trained: Callable[[str], Trained]) -> None:
    found = trained(family)
    found.prepare(observation())
    change, words = OBSERVATIONS[what]
    seen = observation()
    change(seen)
    with pytest.raises(FluxError) as error:
        found.prepare(seen)
    prompt = found.prompt or {}
    limit = prompt.get("max_len", 64)  # of ProcessOpenVLAPrompts, where nothing else is said
    assert re.search(words.replace("{max_len}", str(limit)), error.value.what)
    assert len(error.value.what) < 400


@pytest.mark.parametrize("family", ["gr00t_n15", "gr00t_n17"])
def test_image_tokens_are_never_cut(family: str, trained: Callable[[str], Trained]) -> None:
    """However short the limit is: their number is in the message."""
    found = trained(family)
    tables = deepcopy(found.table["transforms"])
    for table in tables:
        if table["type"] == (found.prompt or {})["type"]:
            table["max_len"] = 5
    prepare = PrivateInferenceDataset(
        found.table["img_keys"], tables, found.dataset.statistics, statistic_name=found.entry
    )
    places = {"gr00t_n15": "2 x 4 places for images", "gr00t_n17": "2 x 1 image tokens"}[family]
    with pytest.raises(FluxError, match=rf"has \d+ tokens with {places}, max_len is 5"):
        prepare(observation())


@pytest.mark.parametrize("family", SHIPPED)
def test_further_cameras_are_not_looked_at(family: str, trained: Callable[[str], Trained]) -> None:
    prepare, seen = trained(family).prepare, observation()
    usual = prepare(seen)["images"]
    seen["images"]["another"] = np.full((9, 9, 3), 255, np.uint8)
    assert (prepare(seen)["images"] == usual).all()


# -- checkpoints -----------------------------------------------------------------------------------


def table_of(files: Files) -> dict[str, Any]:
    found: dict[str, Any] = files[CONFIG]["config"]["train_dataloader"]["dataset"]
    return found


def without(*names: str) -> Callable[[Files, str], object]:
    def change(files: Files, entry: str) -> None:
        for name in names:
            files[STATISTICS][entry]["action"].pop(name)

    return change


CHECKPOINTS: dict[str, tuple[Callable[[Files, str], object], str]] = {
    "no statistics of actions": (
        lambda files, entry: files[STATISTICS][entry].pop("action"),
        r"(the statistics have no entry 'action'; they have proprio|"
        r"the statistics of 'action' lack \w+, .*; they have nothing)",
    ),
    "a statistic that is needed is missing": (
        without("std", "q01", "min"),
        r"(have no '(std|q01|min)'|'action' lack (q01, min|min)); they have .*mean",
    ),
    "statistics of another name": (
        lambda files, entry: files[STATISTICS].update({"other": files[STATISTICS].pop(entry)}),
        r"the statistics have no '\w+'; they have other",
    ),
    "a robot of 13 joints": (
        lambda files, _: files[EMBODIMENT].update(joints=files[EMBODIMENT]["joints"][:-1]),
        r"\b13\b.*the statistics.* \(?14\b",
    ),
    "chunks of 5": (
        lambda files, _: files[POLICY].update(horizon=5),
        r"(has (8|1) actions, the horizon of the checkpoint's policy.json is 5|"
        r"actions of 5 steps, the statistics 'action' describe 8 steps one by one)",
    ),
    "a config of another format": (
        lambda files, _: files[CONFIG].update(format="fluxvla-config-2"),
        "the config has format 'fluxvla-config-2'; this version reads 'fluxvla-config-1'",
    ),
}
ONE_CAMERA = {
    "act": "model.num_cameras: ACT: the number of cameras is 2, in the data it is 1",
    "diffusion": "DiffusionPolicy: the number of cameras is 2, in the data it is 1",
    "llava": "LlavaVLA: the number of cameras is 2, in the data it is 1",
    "compact": "CompactVLA: the number of cameras is 2, in the data it is 1",
    "openvla_oft": "OpenVLAOFT: the number of cameras is 2, in the data it is 1",
    "gr00t_n15": "num_images is 2, the sample has 1 images",
}
"""Families whose model, or prompt, is of so many images."""


@pytest.fixture
def unbuilt(monkeypatch: pytest.MonkeyPatch, trained: Callable[[str], Trained]) -> Any:
    """The family's model cannot be built while this is used."""

    def forbid(family: str) -> None:
        cls = VLAS.get(trained(family).tree["model"]["type"])

        @wraps(cls.__init__)
        def refuse(*_: Any, **__: Any) -> None:
            raise AssertionError("the model was built")

        monkeypatch.setattr(cls, "__init__", refuse)

    return forbid


def refused(place: Path) -> str:
    with pytest.raises(FluxError) as error:
        load_policy(place)
    assert error.value.exit_code == 2
    assert str(place) in (error.value.where or "")
    return error.value.what


@pytest.mark.parametrize("family", SHIPPED)
def test_a_checkpoint_is_whole_but_for_its_weights(
    family: str, trained: Callable[[str], Trained], tmp_path: Path
) -> None:
    """So that the tests below find what they look for."""
    with pytest.raises(CheckpointError, match=r"the checkpoint has no \w+\.(safetensors|json)"):
        load_policy(trained(family).save(tmp_path))


@pytest.mark.parametrize("what", CHECKPOINTS)
@pytest.mark.parametrize("family", SHIPPED)
def test_checkpoints(
    family: str, what: str, trained: Callable[[str], Trained], tmp_path: Path, unbuilt: Any
) -> None:
    change, words = CHECKPOINTS[what]
    place = trained(family).save(tmp_path, change)
    unbuilt(family)
    assert re.search(words, refused(place))


@pytest.mark.parametrize("family", ONE_CAMERA)
def test_a_checkpoint_for_other_cameras(
    family: str, trained: Callable[[str], Trained], tmp_path: Path, unbuilt: Any
) -> None:
    place = trained(family).save(
        tmp_path, lambda files, _: table_of(files).update(img_keys=list(CAMERAS[:1]))
    )
    unbuilt(family)
    assert ONE_CAMERA[family] in refused(place)


@pytest.mark.parametrize("family", [f for f in SHIPPED if f not in ("compact", "act", "diffusion")])
def test_a_checkpoint_with_a_tokenizer_of_more_words(
    family: str, trained: Callable[[str], Trained], tmp_path: Path, unbuilt: Any
) -> None:
    found = trained(family)
    write_tokenizers(tmp_path, family, more=2000)

    def exchange(files: Files, _: str) -> None:
        for transform in table_of(files)["transforms"]:
            if transform.get("tokenizer", {}).get("type") == "PretrainedTokenizer":
                transform["tokenizer"]["model_path"] = str(tmp_path / "words")

    place = found.save(tmp_path / "work", exchange)
    unbuilt(family)
    words = r"ids of tokens are below (264|416|1024), in the data they go up to 2\d\d\d$"
    assert re.search(words, refused(place))


@pytest.mark.parametrize("family", ["gr00t_n15", "gr00t_n17"])
def test_a_checkpoint_of_a_robot_without_weights(
    family: str, trained: Callable[[str], Trained], tmp_path: Path, unbuilt: Any
) -> None:
    place = trained(family).save(
        tmp_path, lambda files, _: table_of(files).update(embodiment_id=99)
    )
    unbuilt(family)
    assert "embodiment_ids are below 32, in the data one is 99" in refused(place)


@pytest.mark.parametrize(("theirs", "ours"), list(pairwise([*SHIPPED, "pi0"])))
def test_a_training_does_not_start_from_another_family(
    theirs: str, ours: str, trained: Callable[[str], Trained], tmp_path: Path
) -> None:
    place = trained(theirs).save(tmp_path)
    own, other = (trained(name).tree["model"] for name in (ours, theirs))
    check_family(str(place), other)
    with pytest.raises(CheckpointError) as error:
        check_family(str(place), own)
    said = error.value.what
    if own["type"] == other["type"]:
        assert said == (
            "the vlm_backbone of the checkpoint's GR00T is EagleBackbone, that of the config's "
            "model is Qwen3VLBackbone"
        )
    else:
        assert said == f"the checkpoint is of {other['type']}, the config's model is {own['type']}"
    assert error.value.where == str(place)
