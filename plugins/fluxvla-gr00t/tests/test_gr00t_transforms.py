"""Images, prompts and normalised values as GR00T N1.7 takes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from fluxvla_gr00t.qwen3_vl import images_to_patches
from fluxvla_gr00t.transforms import ClipNormalized, ProcessQwenPrompts, ResizeCropImages
from safetensors.torch import load_file

from fluxvla_core.errors import ConfigError
from tests.oracles import fill

GOLDEN = Path(__file__).parent / "golden" / "lerobot061_n17_images.safetensors"
SIZES = {"wide": (60, 80), "tall": (90, 50)}
SPECIAL = ("<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>", "<|image_pad|>")


class Letters:
    """One token for each special word, and for each other letter its number."""

    pad_token_id = 7
    padding_side = "right"
    model_path = None

    def encode(self, text):
        ids = []
        while text:
            word = next((w for w in SPECIAL if text.startswith(w)), text[0])
            ids.append(1000 + SPECIAL.index(word) if word in SPECIAL else ord(word))
            text = text[len(word) :]
        return ids

    def save_pretrained(self, folder):
        raise NotImplementedError


class Cut(Letters):
    """Knows no special words."""

    def encode(self, text):
        return [ord(letter) for letter in text]


def image(name):
    made = fill.integers(f"picture {name}", (*SIZES[name], 3), 256).astype(np.uint8)
    return made.transpose(2, 0, 1)


def patches(planes):
    """As the model cuts normalised images."""
    normal = torch.from_numpy(planes).float() / 255 * 2 - 1
    return images_to_patches(normal[None], 16, 2)


@pytest.mark.parametrize("name", SIZES)
@pytest.mark.parametrize("kind", ["plain", "square"])
@pytest.mark.parametrize("method", ["bicubic", "area"])
def test_images_are_the_reference_s(name, kind, method):
    known = load_file(GOLDEN)
    resize = ResizeCropImages(64, crop_fraction=58 / 64, method=method, letter_box=kind == "square")
    made = resize({"images": [image(name)]})["images"]
    assert made.dtype == np.uint8
    if kind == "square" or method == "bicubic":
        assert np.array_equal(made, known[f"{name}.{kind}.{method}"].numpy())
    if kind == "plain":
        _, rows, columns = known[f"{name}.{kind}.{method}.grid"][0].tolist()
        assert made.shape == (3, 16 * rows, 16 * columns)
        expected = known[f"{name}.{kind}.{method}.patches"]
        torch.testing.assert_close(patches(made)[::16], expected, rtol=0, atol=1e-6)


def test_patches_are_those_of_transformers():
    processing = pytest.importorskip(
        "transformers.models.qwen2_vl.image_processing_pil_qwen2_vl"
    ).Qwen2VLImageProcessorPil
    processor = processing(
        patch_size=16,
        merge_size=2,
        temporal_patch_size=2,
        image_mean=[0.5] * 3,
        image_std=[0.5] * 3,
        do_resize=False,
    )
    planes = fill.integers("square", (3, 64, 96), 256).astype(np.uint8)
    expected = processor([planes.transpose(1, 2, 0)], return_tensors="pt")["pixel_values"]
    torch.testing.assert_close(patches(planes), expected, rtol=0, atol=1e-6)


def test_the_prompt_is_qwen3_s_chat_with_places_for_every_image():
    process = ProcessQwenPrompts(Letters(), max_len=60)
    sample = {"images": np.zeros((6, 32, 64), np.uint8), "task_description": "Lift the Cup!"}
    made = process(sample)
    place = SPECIAL.index("<|image_pad|>") + 1000
    seen = "<|vision_start|><|image_pad|><|image_pad|><|vision_end|>"
    text = f"<|im_start|>user\n{seen}{seen}lift the cup<|im_end|>\n"
    ids = Letters().encode(text)
    assert made["lang_tokens"].tolist() == [7] * (60 - len(ids)) + ids
    assert made["lang_masks"].tolist() == [False] * (60 - len(ids)) + [True] * len(ids)
    assert made["lang_tokens"].tolist().count(place) == 4


@pytest.mark.parametrize(
    ("changes", "settings", "words"),
    [
        ({"task_description": "?!"}, {}, "there is no instruction"),
        ({}, {"max_len": 15}, "2 x 2 image tokens, max_len is 15"),
        ({}, {"tokenizer": Cut()}, r"<\|image_pad\|> is not a token"),
        (
            {"task_description": "<|image_pad|>"},
            {"formalize": False},
            "has 5 image tokens, 2 x 2 expected",
        ),
        ({"images": np.zeros((3, 30, 64), np.uint8)}, {}, "30 x 64 pixels"),
    ],
)
def test_prompts_that_cannot_be_made_are_refused(changes, settings, words):
    sample = {"images": np.zeros((6, 32, 64), np.uint8), "task_description": "lift", **changes}
    with pytest.raises(ConfigError, match=words):
        ProcessQwenPrompts(**{"tokenizer": Letters(), **settings})(sample)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"method": "nearest"}, "'nearest' is not one of bicubic, area"),
        ({"size": 250}, "size 250 is not a multiple of 32"),
        ({"crop_fraction": 1.5}, "got 1.5"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(settings, words):
    with pytest.raises(ConfigError, match=words):
        ResizeCropImages(**settings)


def test_outliers_are_clipped_in_states_and_actions():
    clip = ClipNormalized()
    sample = {"states": np.array([-2.0, 0.5]), "actions": np.array([[3.0], [-0.1]])}
    made = clip(sample)
    assert made["states"].tolist() == [-1.0, 0.5]
    assert made["actions"].tolist() == [[1.0], [-0.1]]
    assert "actions" not in clip({"states": sample["states"]})
