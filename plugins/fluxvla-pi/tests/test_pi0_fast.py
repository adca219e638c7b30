"""PI0-FAST: what is learned, how it is answered, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fluxvla_pi.action_tokens import ActionWords, ProcessActionTokens
from fluxvla_pi.pi0_fast import PI0FAST

from fluxvla_core.data import PretrainedTokenizer
from fluxvla_core.data.example import StandInTokenizer
from fluxvla_core.errors import ConfigError

from .oracles import pi_inputs as tiny
from .published_folders import tokenizer_folder
from .tiny import FAST, fast_batch, fast_model


def transform(**settings):
    return ProcessActionTokens(FAST, **{"max_len": 64, "words": tiny.ACTION_WORDS, **settings})


def chunk():
    """Normalised actions ``(T, D)``."""
    rng = np.random.default_rng(2)
    return rng.normal(size=(tiny.HORIZON, tiny.ROBOT_ACTIONS)).astype(np.float32)


def small(**settings):
    torch.manual_seed(0)
    return PI0FAST(FAST, **{**tiny.FAST_SIZES, "max_decoding_steps": 63, **settings})


def seen():
    return {key: v for key, v in fast_batch().items() if not key.startswith("action")}


# -- tokens --------------------------------------------------------------------------------------


def test_a_chunk_is_written_as_an_answer():
    found = transform()({"actions": chunk(), "states": 1})
    words, mask = tiny.ACTION_WORDS, found["action_token_masks"]
    assert found["states"] == 1
    tokens = found["action_tokens"][mask].tolist()
    ids = fast_model()._action_tokenizer().encode_actions(chunk())
    last = words["vocab_size"] - 1 - words["skipped"]
    begun = [words["bos"], *words["begin"]]
    assert tokens == [*begun, *(last - i for i in ids), words["stop"], words["eos"]]
    assert mask.sum() == len(tokens) < 64
    assert not found["action_tokens"][~mask].any()
    assert found["action_tokens"].shape == found["action_token_masks"].shape == (64,)


def test_a_dry_run_without_the_tokenizers_files_has_tokens_of_its_shape():
    found = ProcessActionTokens(StandInTokenizer(), max_len=64)({"actions": chunk()})
    assert found["action_tokens"].shape == (64,)
    assert found["action_token_masks"].sum() == 4 + tiny.HORIZON * tiny.ROBOT_ACTIONS // 4 + 2


def test_paligemmas_words_are_the_default():
    """Token 0 is the last word before those of segmentation, as in openpi."""
    words = ActionWords.of(None, "here")
    assert words.write([0, 2047]) == [2, 4022, 235292, 235248, 257023, 254976, 235371, 1]
    words.check(2048, "here")


def test_too_many_tokens_are_never_cut():
    with pytest.raises(ConfigError, match=r"a chunk of 5 x 7 actions has \d+ tokens, max_len is 9"):
        transform(max_len=9)({"actions": chunk()})


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"begins": [1]}, "words has no begins; it has vocab_size, skipped"),
        ({"begin": []}, "words.begin is empty"),
        ({"stop": 999}, r"are the words .*999.*; there are 0..575"),
        ({"stop": 300}, r"288 action tokens would take the words 160..447, and the answer's own"),
        ({"skipped": 400}, r"would take the words -112..175"),
    ],
)
def test_words_that_cannot_be(words, message):
    table = {**tiny.ACTION_WORDS, **words}
    with pytest.raises(ConfigError, match=message):
        transform(words=table)
    with pytest.raises(ConfigError, match=message):
        small(words=table)


def test_what_is_no_tokenizer_of_actions(tmp_path):
    letters = str(tokenizer_folder(tmp_path / "words"))
    table = {"type": "PretrainedTokenizer", "model_path": letters}
    with pytest.raises(ConfigError, match="PretrainedTokenizer is no tokenizer of actions"):
        ProcessActionTokens(PretrainedTokenizer(letters))({"actions": chunk()})
    with pytest.raises(ConfigError, match="a PretrainedTokenizer, which knows no actions"):
        PI0FAST(table, **tiny.FAST_SIZES)
    with pytest.raises(ConfigError, match="it is not the folder of a FAST tokenizer"):
        PI0FAST({**table, "type": "FastTokenizer"}, **tiny.FAST_SIZES)
    with pytest.raises(ConfigError, match="'nowhere' does not exist"):
        PI0FAST({"type": "FastTokenizer", "model_path": "nowhere"}, **tiny.FAST_SIZES)
    with pytest.raises(ConfigError, match="the sample has no actions"):
        transform()({"states": 1})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"action_dim": 0}, "action_dim 0"),
        ({"temperature": -1.0}, "temperature -1.0"),
        ({"vocab_size": 64}, r"has 576 words \(words.vocab_size\), the language model 64"),
    ],
)
def test_sizes_that_cannot_be(settings, message):
    with pytest.raises(ConfigError, match=message):
        small(**settings)


# -- the model -----------------------------------------------------------------------------------


def test_the_prompt_does_not_see_the_answer_and_padding_is_not_seen():
    model, batch = fast_model(), fast_batch()
    expected = model(**batch)["sample_losses"]
    for key, mask in (("lang_tokens", "lang_masks"), ("action_tokens", "action_token_masks")):
        changed = torch.where(batch[mask], batch[key], 7)
        found = model(**{**batch, key: changed})["sample_losses"]
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=0)
    # One more token at the end: what came before is predicted as before.
    shorter = batch["action_token_masks"].clone()
    shorter[0, 20:] = False
    counts = (shorter[0, 1:].sum(), batch["action_token_masks"][0, 1:].sum())
    less = model(**{**batch, "action_token_masks": shorter})["sample_losses"][0] * counts[0]
    assert 0 < less < expected[0] * counts[1]


def test_a_sample_has_the_loss_that_it_has_alone():
    model, batch = fast_model(), fast_batch()
    expected = model(**batch)["sample_losses"]
    for row in range(tiny.BATCH):
        one = model(**{key: value[row : row + 1] for key, value in batch.items()})
        torch.testing.assert_close(one["loss"], expected[row], rtol=1e-5, atol=0)


def test_it_learns_chunks_and_says_them():
    """Two observations, two chunks: from the loss to the robot's numbers."""
    model = small()
    chunks = np.stack([chunk(), -chunk()])
    written = [transform()({"actions": actions}) for actions in chunks]
    batch = {key: value[:2] for key, value in seen().items()}
    for key in ("action_tokens", "action_token_masks"):
        batch[key] = torch.from_numpy(np.stack([sample[key] for sample in written]))
    optimizer = torch.optim.AdamW(model.parameters(), lr=5e-3)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        loss = model(**batch)["loss"]
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.05 * losses[0]
    acting = {key: v for key, v in batch.items() if not key.startswith("action")}
    with torch.no_grad():
        answers = model.eval().answer(**acting)
        found = model.predict_action(**acting)
    assert (answers == tiny.ACTION_WORDS["stop"]).any(1).all()
    assert answers.shape[1] < 63  # it ended when both had said it
    assert found.shape == (2, *model.action_shape)
    tokenizer = model._action_tokenizer()
    for given, said in zip(chunks, found.numpy(), strict=True):
        expected = tokenizer.decode_actions(
            tokenizer.encode_actions(given), tiny.HORIZON, tiny.ROBOT_ACTIONS
        )
        np.testing.assert_allclose(said, expected, atol=1e-6)


def test_a_warm_answer_follows_from_its_noise_alone():
    model = fast_model(temperature=2.0)
    noise = torch.randn(tiny.BATCH, *model.action_shape, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        found = model.answer(**seen(), noise=noise)
        again = model.answer(**seen(), noise=noise)
        other = model.answer(**seen(), noise=noise + 1)
        alone = model.answer(**{k: v[1:2] for k, v in seen().items()}, noise=noise[1:2])
        coldest = fast_model(temperature=1e-4).answer(**seen(), noise=noise)
    assert torch.equal(found, again)
    assert not torch.equal(found, other)
    assert torch.equal(found[1:2, : alone.shape[1]], alone)
    assert torch.equal(coldest, fast_model().answer(**seen()))
    with pytest.raises(ConfigError, match=r"temperature is 2.0: sampling needs noise"):
        model.predict_action(**seen())


def test_frozen_parts_get_no_gradient():
    model = small(freeze_llm_backbone=True, tied_head=False)
    model(**fast_batch())["loss"].backward()
    trained = {name for name, p in model.named_parameters() if p.grad is not None}
    assert trained
    assert all(name.startswith(("vision_backbone.", "projector.")) for name in trained)
    model = small(freeze_vision_backbone=True)
    model(**fast_batch())["loss"].backward()
    trained = {name for name, p in model.named_parameters() if p.grad is not None}
    assert trained
    assert all(name.startswith("llm_backbone.") for name in trained)
