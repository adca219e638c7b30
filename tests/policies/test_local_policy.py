"""A checkpoint alone is a policy: equal actions for equal seeds, and clear refusals."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fluxvla_core.errors import CheckpointError, ConfigError, DataError, SpecMismatch
from fluxvla_core.models import InputSizes
from fluxvla_core.plugins.registry import VLAS
from fluxvla_core.spec import Camera, EmbodimentSpec, Joint

torch = pytest.importorskip("torch")
safetensors = pytest.importorskip("safetensors.torch")

ARM = EmbodimentSpec(
    "testarm",
    (
        Joint("shoulder", "rad", -1.0, 1.5, 2.0, 10.0),
        Joint("elbow", "rad", -2.0, 2.0, 3.0, 20.0),
    ),
    (Camera("front", 24, 32),),
    50.0,
)
MEAN, STD = [0.1, -0.2], [0.5, 2.0]


class LittleVLA(torch.nn.Module):
    """Actions = gain * noise + the normalised state; remembers what it was given."""

    def __init__(self, action_dim: int = 2) -> None:
        super().__init__()
        self.gain = torch.nn.Parameter(torch.ones(1))
        self.action_dim = action_dim
        self.batch: dict[str, Any] = {}

    @property
    def action_shape(self) -> tuple[int, int]:
        return 4, self.action_dim

    def predict_action(self, images: Any, states: Any, noise: Any) -> Any:
        self.batch = {"images": images, "states": states, "noise": noise}
        return self.gain * noise + states[:, None, : self.action_dim]


class Plain(torch.nn.Module):
    """A model without noise that takes whatever there is."""

    action_shape = (4, 2)

    def __init__(self) -> None:
        super().__init__()
        self.gain = torch.nn.Parameter(torch.ones(1))

    def predict_action(self, **batch: Any) -> Any:
        self.batch = batch
        return torch.zeros(1, 4, 2) + self.gain


@pytest.fixture(autouse=True)
def models():
    for cls in (LittleVLA, Plain):
        VLAS.register_module()(cls)
    yield
    for cls in (LittleVLA, Plain):
        VLAS.unregister(cls.__name__)


def save(
    work_dir: Path, step: int = 100, gain: float = 2.0, ema: float | None = None, **changes: Any
) -> Path:
    """A checkpoint as training writes it."""
    from fluxvla_core.checkpoints.writer import CheckpointWriter

    row = {"mean": MEAN, "std": STD, "min": [-1, -3], "max": [1, 3], "q01": [-1, -3], "q99": [1, 3]}
    dataset = {
        "type": "ParquetDataset",
        "data_root_path": "gone",
        "img_keys": ["observation.images.front"],
        "transforms": [
            {"type": "ResizeImages", "height": 12, "width": 16},
            {"type": "NormalizeImages", "means": [[127.5] * 3], "stds": [[127.5] * 3]},
            {"type": "StateNoise", "std": 0.5, "state_key": "proprio"},
            {"type": "NormalizeStatesAndActions", "norm_type": "mean_std"},
            {"type": "SampleFlowNoise"},
        ],
        **changes.pop("dataset", {}),
    }
    config = {
        "model": {"type": "LittleVLA"},
        "train_dataloader": {"dataset": dataset},
        **changes.pop("config", {}),
    }
    files = {
        "config.resolved.json": {"format": "fluxvla-config-1", "config": config, "origins": {}},
        "dataset_statistics.json": {"private": {"proprio": row, "action": row}},
        "embodiment.json": ARM.to_dict(),
        "policy.json": {"action_rate_hz": 10.0, "horizon": 4},
        "trainer.json": {"left_out": {}},
        **changes,
    }
    with CheckpointWriter(work_dir, step, 1) as writer:
        writer.write_bytes("model.safetensors", safetensors.save({"gain": torch.tensor([gain])}))
        if ema is not None:
            averaged = safetensors.save({"gain": torch.tensor([ema])})
            writer.write_bytes("ema.safetensors", averaged)
        for name, value in files.items():
            if isinstance(value, bytes):
                writer.write_bytes(name, value)
            elif value is not None:
                writer.write_json(name, value)
        return writer.commit()


def observation(pose=(0.3, -0.4)):
    return {
        "qpos": np.array(pose, np.float32),
        "images": {"front": np.full((24, 32, 3), 255, np.uint8)},
        "task_description": "wave at the camera",
    }


def load(path, **arguments):
    from fluxvla_core.policies.loading import load_policy

    return load_policy(path, **arguments)


def test_a_policy_is_made_of_the_checkpoint_alone(tmp_path):
    policy = load(save(tmp_path))
    policy.reset(3)

    chunk = policy.predict_action(observation())

    assert (policy.embodiment, policy.action_rate_hz, policy.horizon) == (ARM, 10.0, 4)
    assert policy.cameras == ("front",)
    assert chunk.shape == (4, 2)
    assert chunk.dtype == np.float64
    batch = policy.model.batch
    assert batch["images"].shape == (1, 3, 12, 16)
    assert float(batch["images"].min()) == pytest.approx(1.0)
    # The state is normalised, without the noise that only training adds; actions are undone.
    states = (np.array([0.3, -0.4]) - MEAN) / (np.array(STD) + 1e-6)
    np.testing.assert_allclose(batch["states"][0].numpy(), states, rtol=1e-5)
    expected = (2 * batch["noise"][0].numpy() + states) * STD + MEAN
    np.testing.assert_allclose(chunk, expected, rtol=1e-4)
    assert set(policy.stages) == {"preprocess", "inference", "postprocess"}


def test_the_noise_follows_from_the_seed_and_the_call(tmp_path):
    policy = load(save(tmp_path))
    runs = []
    for seed in (3, 3, 4):
        policy.reset(seed)
        runs.append([policy.predict_action(observation()) for _ in range(3)])

    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.allclose(runs[0][0], runs[0][1])
    assert not np.allclose(runs[0], runs[2])


def test_a_policy_of_a_mixture_is_for_its_first_dataset(tmp_path):
    alone = load(save(tmp_path / "alone"))
    table = json.loads(
        (tmp_path / "alone/checkpoints/step-000000100/config.resolved.json").read_text()
    )
    first = table["config"]["train_dataloader"]["dataset"]
    mixed = {"type": "DistributedRepeatingDataset", "datasets": [first, {"type": "ParquetDataset"}]}
    policy = load(save(tmp_path / "mixed", config={"train_dataloader": {"dataset": mixed}}))
    for each in (alone, policy):
        each.reset(3)
    np.testing.assert_array_equal(
        alone.predict_action(observation()), policy.predict_action(observation())
    )


def test_averaged_weights_are_preferred(tmp_path):
    assert float(load(save(tmp_path, ema=5.0)).model.gain.detach()) == 5.0


def test_a_model_without_noise_gets_none(tmp_path):
    path = save(tmp_path, config={"model": {"type": "Plain"}})
    policy = load(path)
    policy.reset(0)
    policy.predict_action(observation())

    assert "noise" not in policy.model.batch
    assert {"images", "states", "img_masks"} <= policy.model.batch.keys()


def test_the_specifications_dataset_and_denormalisation_override(tmp_path):
    policy = load(
        save(tmp_path),
        dataset={
            "type": "PrivateInferenceDataset",
            "img_keys": ["front"],
            "transforms": [
                {"type": "ResizeImages", "height": 8, "width": 8},
                {"type": "SimpleNormalizeImages"},
                {"type": "NormalizeStatesAndActions", "norm_type": "none"},
            ],
        },
        denormalize_action={"type": "DenormalizePrivateAction", "norm_type": "mean_std",
                            "action_dim": 2},
    )  # fmt: skip
    policy.reset(0)
    chunk = policy.predict_action(observation())

    batch = policy.model.batch
    assert batch["images"].shape == (1, 3, 8, 8)
    np.testing.assert_allclose(batch["states"][0].numpy(), [0.3, -0.4], rtol=1e-6)
    expected = (2 * batch["noise"][0].numpy() + batch["states"][0].numpy()) * STD + MEAN
    np.testing.assert_allclose(chunk, expected, rtol=1e-4)


def test_images_with_more_pixels_are_scaled_before_pixels_are_cut_by_number(tmp_path):
    crop = {"type": "CropImages", "top": 0, "left": 0, "height": 12, "width": 32}
    transforms = [
        crop,
        {"type": "NormalizeImages", "means": [[0] * 3], "stds": [[1] * 3]},
        {"type": "NormalizeStatesAndActions"},
    ]
    policy = load(save(tmp_path, dataset={"transforms": transforms}))
    policy.reset(0)
    large = observation()
    large["images"]["front"] = np.zeros((96, 128, 3), np.uint8)
    large["images"]["front"][:48] = 200

    policy.predict_action(large)

    # The upper half of the view, whatever its pixels.
    assert policy.model.batch["images"].shape == (1, 3, 12, 32)
    assert float(policy.model.batch["images"].min()) == pytest.approx(200, rel=1e-6)

    large["images"]["front"] = np.zeros((0, 128, 3), np.uint8)
    with pytest.raises(DataError, match=r"gives uint8 of shape \(0, 128, 3\)"):
        policy.predict_action(large)
    large["images"]["front"] = np.zeros((96, 96, 3), np.uint8)
    with pytest.raises(DataError, match=r"'front' gives 96 x 96 images; .* on 24 x 32: another vi"):
        policy.predict_action(large)


def test_bf16_computes_and_still_gives_float64(tmp_path):
    policy = load(save(tmp_path), mixed_precision_dtype="bf16")
    policy.reset(0)

    assert policy.predict_action(observation()).dtype == np.float64
    with pytest.raises(
        ConfigError, match="mixed_precision_dtype 'fp16' is unknown; choose one of float32, bf16"
    ):
        load(save(tmp_path), mixed_precision_dtype="fp16")


@pytest.mark.parametrize(
    ("environment", "count", "device"),
    [
        ({}, 8, "cuda"),
        ({"LOCAL_RANK": "0"}, 8, "cuda:0"),
        ({"LOCAL_RANK": "5"}, 8, "cuda:5"),
        ({"LOCAL_RANK": "5"}, 2, "cuda:1"),
        ({"LOCAL_RANK": "3"}, 1, "cuda:0"),
        ({"LOCAL_RANK": "3"}, 0, "cuda"),
        ({"SLURM_LOCALID": "2"}, 4, "cuda:2"),
        ({"LOCAL_RANK": "1", "SLURM_LOCALID": "0"}, 4, "cuda:1"),
    ],
)
def test_processes_of_one_machine_have_a_gpu_each(environment, count, device):
    from fluxvla_core.policies.loading import own_device

    assert own_device(environment, count) == device


def test_a_plain_cuda_is_the_gpu_of_this_process(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(torch.nn.Module, "to", lambda self, device: asked.append(device) or self)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setenv("LOCAL_RANK", "3")
    path = save(tmp_path)
    assert load(path, device="cuda").device == "cuda:1"
    assert load(path, device="cuda:0").device == "cuda:0"
    assert asked == ["cuda:1", "cuda:0"]


def test_a_work_dir_means_its_newest_whole_checkpoint(tmp_path):
    from fluxvla_core.policies.loading import find_checkpoint

    save(tmp_path, step=100)
    newest = save(tmp_path, step=200)
    assert find_checkpoint(None, tmp_path) == newest
    assert find_checkpoint(newest, tmp_path / "elsewhere") == newest

    (newest / "model.safetensors").write_bytes(b"")
    assert find_checkpoint(None, tmp_path).name == "step-000000100"


def test_a_work_dir_that_is_named_means_its_newest_whole_checkpoint_too(tmp_path, caplog):
    from fluxvla_core.policies.loading import find_checkpoint, load_policy

    whole = save(tmp_path, step=100)
    damaged = save(tmp_path, step=200)
    (damaged / "model.safetensors").write_bytes(b"")

    assert find_checkpoint(tmp_path, tmp_path / "elsewhere") == whole
    assert "damaged" in caplog.text
    assert damaged.name in caplog.text
    assert load_policy(tmp_path).source == str(whole)
    with pytest.raises(CheckpointError, match="damaged"):
        load_policy(damaged)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"embodiment.json": None}, SpecMismatch, "does not say the embodiment: what its actions"),
        (
            {"policy.json": {"action_rate_hz": None, "horizon": None}},
            SpecMismatch,
            "does not say action_rate_hz, horizon",
        ),
        ({"dataset": {"use_delta": True}}, SpecMismatch, "trained with use_delta=True"),
        (
            {"config": {"train_dataloader": {}}},
            CheckpointError,
            "train_dataloader.dataset has no img_keys, transforms",
        ),
        ({"dataset": {"transforms": []}}, ConfigError, "no transform knows how actions were"),
    ],
)
def test_what_a_checkpoint_does_not_say_is_named(tmp_path, changes, error, message):
    path = save(tmp_path, **changes)

    with pytest.raises(error, match=message) as caught:
        load(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("rate", "horizon", "message"),
    [
        ("-1", "4", "action_rate_hz: input should be greater than 0"),
        ("0", "4", "action_rate_hz: input should be greater than 0"),
        ("1e999", "4", "action_rate_hz: input should be less than inf"),
        ("NaN", "4", "action_rate_hz: "),
        ('"10"', "4", "action_rate_hz: input should be a valid number"),
        ("10.0", "0", "horizon: input should be greater than or equal to 1"),
        ("10.0", "2.5", "horizon: input should be a valid integer"),
    ],
)
def test_chunks_that_cannot_be_played_are_refused_on_loading(tmp_path, rate, horizon, message):
    text = f'{{"action_rate_hz": {rate}, "horizon": {horizon}}}'
    path = save(tmp_path, **{"policy.json": text.encode()})

    with pytest.raises(CheckpointError, match=re.escape(f"policy.json: {message}")) as caught:
        load(path)
    assert str(path) in str(caught.value)


def test_a_config_without_a_model_is_no_policy(tmp_path):
    path = save(tmp_path)
    config = json.loads((path / "config.resolved.json").read_text())
    del config["config"]["model"]
    changed = {"config.resolved.json": config}

    with pytest.raises(CheckpointError, match="the checkpoint's config has no section 'model'"):
        load(save(tmp_path, step=300, **changed))


def test_weights_of_another_model_and_damaged_files_are_refused(tmp_path):
    path = save(tmp_path)
    (path / "dataset_statistics.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"dataset_statistics.json is damaged"):
        load(path)
    from fluxvla_core.checkpoints.writer import CheckpointWriter

    with CheckpointWriter(tmp_path, 400, 1) as writer:
        for name in ("config.resolved.json", "embodiment.json", "policy.json", "trainer.json"):
            writer.write_bytes(name, (path / name).read_bytes())
        stats = {"private": {k: {"mean": MEAN, "std": STD} for k in ("proprio", "action")}}
        writer.write_json("dataset_statistics.json", stats)
        other = safetensors.save({"other": torch.zeros(3)})
        writer.write_bytes("model.safetensors", other)
        wrong = writer.commit()
    with pytest.raises(CheckpointError, match="gain"):
        load(wrong)


class SizedVLA(LittleVLA):
    """Says what it takes, and must not be built of what does not fit."""

    input_sizes = InputSizes(
        cameras="num_cameras", image_size=(12, 16), states="action_dim", horizon=4
    )

    def __init__(self, action_dim: int = 2, num_cameras: int = 1) -> None:
        raise AssertionError("it was built")


@pytest.fixture
def sized():
    VLAS.register_module()(SizedVLA)
    yield {"type": "SizedVLA"}
    VLAS.unregister("SizedVLA")


@pytest.mark.parametrize(
    ("model", "changes", "words"),
    [
        ({"num_cameras": 2}, {}, "model.num_cameras: SizedVLA: the number of cameras is 2, in the"),
        (
            {"action_dim": 3},
            {},
            "model.action_dim: SizedVLA: the width of states is 3, in the data",
        ),
        ({}, {"policy.json": {"action_rate_hz": 10.0, "horizon": 5}}, "has 4 actions, the horizon"),
    ],
)
def test_a_model_that_does_not_take_what_it_would_be_given_is_not_built(
    tmp_path, sized, model, changes, words
):
    path = save(tmp_path, config={"model": {**sized, **model}}, **changes)
    with pytest.raises(SpecMismatch, match=words) as error:
        load(path)
    assert error.value.where == str(path)


def test_images_of_another_size_are_refused_before_the_model_is_built(tmp_path, sized):
    kept = [{"type": "NormalizeStatesAndActions", "norm_type": "mean_std"}]
    path = save(tmp_path, config={"model": sized}, dataset={"transforms": kept})
    with pytest.raises(SpecMismatch, match="size of images is 12 x 16, in the data it is 24 x 32"):
        load(path)


def test_who_drives_the_robot_can_refuse_before_the_model_is_built(tmp_path, sized):
    def check(robot: EmbodimentSpec, cameras: tuple[str, ...]) -> None:
        assert (robot, cameras) == (ARM, ("front",))
        raise SpecMismatch("another robot")

    with pytest.raises(SpecMismatch, match="another robot"):
        load(save(tmp_path, config={"model": sized}), check=check)


class ReadingVLA(LittleVLA):
    """Embeds 30 tokens, fewer than the tokenizer has with those that were added to it."""

    input_sizes = InputSizes(vocabulary="words")

    def __init__(self, words: int = 30) -> None:
        super().__init__()

    def predict_action(self, images: Any, states: Any, noise: Any, lang_tokens: Any) -> Any:
        return super().predict_action(images, states, noise)


@pytest.fixture
def reading(tmp_path):
    from tokenizers import Tokenizer, models, pre_tokenizers

    words = ["<unk>", "wave", "at", "the", "camera", *(f"word{i}" for i in range(25))]
    known = {word: i for i, word in enumerate(words)}
    made = Tokenizer(models.WordLevel(known, unk_token="<unk>"))
    made.pre_tokenizer = pre_tokenizers.Whitespace()
    made.add_special_tokens(["<loc>"])
    (tmp_path / "words").mkdir()
    made.save(str(tmp_path / "words" / "tokenizer.json"))
    tokenizer = {"type": "PretrainedTokenizer", "model_path": str(tmp_path / "words")}
    transforms = [
        {"type": "ResizeImages", "height": 12, "width": 16},
        {"type": "NormalizeStatesAndActions", "norm_type": "mean_std"},
        {"type": "ProcessPrompts", "tokenizer": tokenizer, "max_len": 8},
    ]
    VLAS.register_module()(ReadingVLA)
    yield lambda **model: save(
        tmp_path,
        config={"model": {"type": "ReadingVLA", **model}},
        dataset={"transforms": transforms},
    )
    VLAS.unregister("ReadingVLA")


def test_an_instruction_with_a_token_that_the_model_does_not_embed(reading):
    place = reading()
    policy = load(place)
    assert policy.predict_action(observation()).shape == (4, 2)
    typed = {**observation(), "task_description": "wave at <loc>"}
    said = f"the instruction 'wave at <loc>' has the token 30; the policy of {place} knows those"
    with pytest.raises(ConfigError, match=re.escape(f"{said} below 30")) as error:
        policy.predict_action(typed)
    assert error.value.next == "use other words, or name the model's own tokenizer"
    assert policy.predict_action(observation()).shape == (4, 2)


def test_a_tokenizer_of_more_words_than_the_model_embeds(reading):
    place = reading(words=29)
    words = "model.words: ReadingVLA: ids of tokens are below 29, in the data they go up to 29"
    with pytest.raises(SpecMismatch, match=words) as error:
        load(place)
    assert error.value.where == str(place)
