"""PI0-FAST against LeRobot 0.6.1 (``oracles/make_lerobot061_fast.py``), and against openpi's own
model in JAX (``oracles/make_openpi_fast.py``)."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import load_file

from .oracles import pi_inputs as tiny
from .tiny import GOLDEN, fast_batch, fast_model, relative


@pytest.fixture(scope="module")
def golden():
    return load_file(GOLDEN / "lerobot061_pi0_fast.safetensors")


@pytest.fixture(scope="module")
def model():
    return fast_model()


def seen():
    """The observations of the batch."""
    return {key: v for key, v in fast_batch().items() if not key.startswith("action")}


def test_losses(model, golden):
    found = model(**fast_batch())
    assert relative(found["sample_losses"], golden["losses"]) < 1e-5
    assert found["loss"].item() == pytest.approx(golden["losses"].mean().item(), rel=1e-5)


def test_the_references_loss_of_a_batch_weighs_samples_by_their_tokens(model, golden):
    """LeRobot's is one mean over the batch's tokens."""
    counts = fast_batch()["action_token_masks"][:, 1:].sum(1)
    each = model(**fast_batch())["sample_losses"]
    found = (each * counts).sum() / counts.sum()
    assert found.item() == pytest.approx(golden["batch_loss"].item(), rel=1e-5)


def test_gradients(model, golden):
    from fluxvla_pi.names import LEROBOT

    model.zero_grad()
    model(**fast_batch())["loss"].backward()
    names = {LEROBOT.theirs(n).removeprefix("model."): p for n, p in model.named_parameters()}
    compared = [name for name in golden if name.startswith("gradient.")]
    assert len(compared) > 11
    for name in compared:
        found = names[name.removeprefix("gradient.")].grad
        assert relative(found, golden[name]) < 1e-5, name


@pytest.mark.parametrize("bos_in_prompt", [True, False])
def test_answers(model, golden, bos_in_prompt):
    """As LeRobot samples, and by the attention that it trains with."""
    model.bos_in_prompt = bos_in_prompt
    with torch.no_grad():
        found = model.answer(**seen())
    key = "answers" if bos_in_prompt else "answers.training_mask"
    assert torch.equal(found, golden[key])
    assert len(golden[key].unique()) > 8


def test_what_answers_mean(model, golden):
    tokenizer = model._action_tokenizer()
    answers = tiny.fast_answers(golden["ids"].tolist())
    for name, answer in answers.items():
        found = tokenizer.decode_actions(model.words.read(answer), *model.action_shape)
        expected = golden[f"actions.{name}"].double()
        assert (torch.from_numpy(found) - expected).abs().max() < 1e-5, name
    assert golden["actions.too_short"].abs().max() > 1
    assert not golden["actions.beyond_the_last"].any()


# -- openpi's JAX code: every camera is there, and the head is the embedding ----------------------


@pytest.fixture(scope="module")
def openpi():
    return load_file(GOLDEN / "openpi_pi0_fast.safetensors")


@pytest.fixture(scope="module")
def tied():
    return fast_model(tied_head=True)


def whole(batch):
    return {**batch, "img_masks": torch.ones_like(batch["img_masks"])}


def test_losses_and_gradients_of_openpi(tied, openpi):
    from fluxvla_pi.names import LEROBOT

    tied.zero_grad()
    found = tied(**whole(fast_batch()))
    assert relative(found["sample_losses"], openpi["losses"]) < 1e-5
    found["loss"].backward()
    named = {LEROBOT.theirs(name): p for name, p in tied.named_parameters()}
    compared = [name for name in openpi if name.startswith("gradient.")]
    assert len(compared) > 13
    for name in compared:
        found = named[name.removeprefix("gradient.")].grad
        assert relative(found, openpi[name]) < 1e-5, name


def test_answers_of_openpi(tied, openpi):
    with torch.no_grad():
        found = tied.answer(**whole(seen()))
    expected = openpi["answers.training"]
    assert torch.equal(found, expected[:, : found.shape[1]])
    # Its sampling has the first token where training has it, and the others one place further.
    assert torch.equal(found[:, 0], openpi["answers.sampled"][:, 0])
