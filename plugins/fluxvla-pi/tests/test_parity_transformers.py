"""PI0 against transformers' ``PI0ForConditionalGeneration`` with the same weights."""

from __future__ import annotations

import math

import pytest
import torch
from fluxvla_pi.names import TRANSFORMERS, sources

from .oracles.pi_inputs import (
    ACTIONS,
    BATCH,
    CAMERAS,
    EXPERT,
    GEMMA,
    HORIZON,
    PATCHES,
    STATES,
    VISION,
    VOCABULARY,
    inputs,
)
from .tiny import acting_batch, model_of, relative, training_batch

pytest.importorskip("transformers.models.pi0", reason="transformers >= 5.20 has PI0")
IMAGE = VOCABULARY  # the id of an image's token, beyond the words


def decoder(size):
    return {
        "model_type": "gemma",
        "hidden_size": size["width"],
        "num_hidden_layers": size["depth"],
        "intermediate_size": size["mlp_dim"],
        "num_attention_heads": size["heads"],
        "num_key_value_heads": size["kv_heads"],
        "head_dim": size["head_dim"],
        "vocab_size": VOCABULARY,
    }


def their_config():
    """Of a tiny model."""
    from transformers import PI0Config

    vision = {
        "model_type": "siglip_vision_model",
        "intermediate_size": VISION["mlp_dim"],
        "hidden_size": VISION["width"],
        "patch_size": VISION["patch_size"],
        "image_size": VISION["image_size"],
        "num_hidden_layers": VISION["depth"],
        "num_attention_heads": VISION["heads"],
        "vision_use_head": False,
    }
    return PI0Config(
        vlm_config={
            "model_type": "paligemma",
            "text_config": decoder(GEMMA),
            "vision_config": vision,
            "projection_dim": GEMMA["width"],
            "image_token_id": IMAGE,
        },
        dit_config=decoder(EXPERT),
        chunk_size=HORIZON,
        max_state_dim=STATES,
        max_action_dim=ACTIONS,
    )


@pytest.fixture(scope="module")
def pair():
    """Our model and theirs, with the same weights."""
    from transformers import PI0ForConditionalGeneration

    theirs = PI0ForConditionalGeneration(their_config()).eval()
    ours = model_of("pi0", TRANSFORMERS)
    state = ours.state_dict()
    named = theirs.state_dict()
    taken = sources(state, named, "transformers")
    theirs.load_state_dict({**named, **{name: state[key] for key, name in taken.items()}})
    # transformers rounds the frequencies of the time's sines to float32, by which angles of up to
    # 1570 are off by 1e-4; openpi and LeRobot keep float64.
    share = torch.linspace(0, 1, EXPERT["width"] // 2, dtype=torch.float64)
    frequencies = 2 * math.pi / (4e-3 * (4.0 / 4e-3) ** share)
    sines = theirs.embed_action_time.sinusoid_embeds
    torch.testing.assert_close(sines.sinusoid_freq.double(), frequencies, rtol=1e-6, atol=0)
    sines.sinusoid_freq = frequencies
    return ours, theirs, taken


def their_batch():
    """Images as tokens between words; those of a camera that is not there are padding."""
    batch = {key: torch.from_numpy(value) for key, value in inputs().items()}
    seen = batch["img_masks"].repeat_interleave(PATCHES, 1)
    image_tokens = torch.where(seen, IMAGE, 0)
    side = VISION["image_size"]
    return {
        "state": batch["states"],
        "input_ids": torch.cat([image_tokens, batch["lang_tokens"]], 1),
        "attention_mask": torch.cat([seen, batch["lang_masks"]], 1).long(),
        "pixel_values": batch["images"].reshape(BATCH, CAMERAS, 3, side, side),
        "pixel_attention_mask": batch["img_masks"],
        "noise": batch["noise"],
        "actions": batch["actions"],
        "timestep": batch["tau"],
    }


def test_loss_and_gradients(pair):
    ours, theirs, taken = pair
    ours.zero_grad(), theirs.zero_grad()
    found = ours(**training_batch())["loss"]
    expected = theirs(**their_batch()).loss
    assert found.item() == pytest.approx(expected.item(), rel=1e-5)
    found.backward(), expected.backward()
    gradients = {name: p.grad for name, p in theirs.named_parameters()}
    compared = 0
    for name, parameter in ours.named_parameters():
        if parameter.grad is None:
            assert not parameter.requires_grad
            assert gradients[taken[name]] is None or not gradients[taken[name]].any()
            continue
        if name.endswith("self_attn.k_proj.bias"):
            # It shifts all scores of a softmax alike, so this is 0 but for rounding.
            assert parameter.grad.abs().max() < 1e-9
            continue
        assert relative(parameter.grad, gradients[taken[name]]) < 1e-5, name
        compared += 1
    assert compared > 90


def test_sampled_actions(pair):
    ours, theirs, _ = pair
    batch = their_batch()
    del batch["actions"], batch["timestep"]
    with torch.no_grad():
        found, expected = ours.predict_action(**acting_batch()), theirs.sample_actions(**batch)
    assert relative(found, expected) < 1e-5
