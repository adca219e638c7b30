"""FAST tokens against scipy's transform and transformers' reading of the same files."""

from __future__ import annotations

import json
import logging

import numpy as np
import pytest
from fluxvla_models.fast_tokenizer import FastTokenizer, fit
from scipy.fft import dct, idct

from fluxvla_core.errors import ConfigError, DataError

HORIZON, DIM = 20, 5


def chunks(count, seed=0):
    """Random walks, ``(count, T, D)``."""
    steps = np.random.default_rng(seed).normal(size=(count, HORIZON, DIM))
    return steps.cumsum(1) / 8


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    target = tmp_path_factory.mktemp("fast")
    fit(chunks(200), target, vocab_size=600)
    return target


@pytest.fixture(scope="module")
def tokenizer(folder):
    return FastTokenizer(str(folder))


def test_tokens_are_those_of_the_published_algorithm(tokenizer, folder):
    """The equations of the paper by scipy, the byte-pair encoding by transformers."""
    from transformers import PreTrainedTokenizerFast

    reference = PreTrainedTokenizerFast.from_pretrained(folder, trust_remote_code=False)
    for chunk in [*chunks(40), *chunks(40, 1), *chunks(40, 1).astype(np.float32)]:
        rounded = np.around(dct(chunk, axis=0, norm="ortho") * tokenizer.scale)
        codes = np.maximum(rounded.flatten() - tokenizer.min_token, 0).astype(int)
        ids = tokenizer.encode_actions(chunk)
        assert ids == reference("".join(map(chr, codes)))["input_ids"]
        back = np.array([ord(c) for c in reference.decode(ids)]) + tokenizer.min_token
        expected = idct(back.reshape(-1, DIM) / tokenizer.scale, axis=0, norm="ortho")
        found = tokenizer.decode_actions(ids, HORIZON, DIM)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_a_chunk_comes_back_within_the_rounding(tokenizer):
    for chunk in chunks(20):
        found = tokenizer.decode_actions(tokenizer.encode_actions(chunk), HORIZON, DIM)
        # Each coefficient is rounded by half a step at most, and the transform keeps lengths.
        error = np.linalg.norm(found - chunk, axis=0).max()
        assert error <= 0.5 / tokenizer.scale * HORIZON**0.5 + 1e-9


def test_a_smooth_chunk_has_few_tokens(tokenizer):
    lengths = [len(tokenizer.encode_actions(chunk)) for chunk in chunks(50)]
    assert np.mean(lengths) < 0.6 * HORIZON * DIM


def test_what_is_below_the_lowest_coefficient_becomes_it(tokenizer):
    low = np.full((HORIZON, DIM), -100.0)
    found = tokenizer.decode_actions(tokenizer.encode_actions(low), HORIZON, DIM)
    np.testing.assert_allclose(found.mean(), tokenizer.min_token / 10 / HORIZON**0.5)


def test_another_number_of_coefficients(tokenizer, caplog):
    chunk = chunks(1, 3)[0]
    ids = tokenizer.encode_actions(chunk)
    whole = tokenizer.decode_actions(ids, HORIZON, DIM)
    text = tokenizer.decode(ids, skip_special_tokens=False)
    shorter = tokenizer._tokenizer.encode(text[:12]).ids

    found = dct(tokenizer.decode_actions(shorter, HORIZON, DIM), axis=0, norm="ortho").flatten()
    expected = dct(whole, axis=0, norm="ortho").flatten()
    np.testing.assert_allclose(found[:12], expected[:12], atol=1e-9)
    assert not np.round(found[12:], 9).any()
    np.testing.assert_allclose(tokenizer.decode_actions([*ids, *ids], HORIZON, DIM), whole)
    assert not caplog.records

    with caplog.at_level(logging.WARNING):
        assert not tokenizer.decode_actions(shorter, HORIZON, DIM, strict=True).any()
    assert "12 coefficients, not 100" in caplog.text


def test_what_is_no_chunk_is_zeros(tokenizer, caplog):
    ids = tokenizer.encode_actions(chunks(1)[0])
    np.testing.assert_array_equal(
        tokenizer.decode_actions([*ids, 10**6], HORIZON, DIM),  # no token: left out
        tokenizer.decode_actions(ids, HORIZON, DIM),
    )
    first_of_two_bytes = tokenizer._tokenizer.token_to_id("Ã")
    for wrong in ([*ids[:3], -1], [first_of_two_bytes, *ids]):
        assert not tokenizer.decode_actions(wrong, HORIZON, DIM).any()
    assert caplog.text.count("something that is no chunk") == 2
    assert not tokenizer.decode_actions([], HORIZON, DIM).any()


def test_a_copy_of_its_folder_is_the_same(tokenizer, tmp_path):
    tokenizer.save_pretrained(tmp_path / "copy")
    copy = FastTokenizer(str(tmp_path / "copy"))
    chunk = chunks(1, 9)[0]
    assert copy.encode_actions(chunk) == tokenizer.encode_actions(chunk)
    assert (copy.scale, copy.min_token) == (tokenizer.scale, tokenizer.min_token)


def test_python_code_in_the_folder_is_never_run(tokenizer, tmp_path):
    tokenizer.save_pretrained(tmp_path)
    (tmp_path / "processing_action_tokenizer.py").write_text("raise SystemExit(1)")
    settings = json.loads((tmp_path / "processor_config.json").read_text())
    settings["auto_map"] = {"AutoProcessor": "processing_action_tokenizer.Processor"}
    (tmp_path / "processor_config.json").write_text(json.dumps(settings))
    assert FastTokenizer(str(tmp_path)).min_token == tokenizer.min_token


@pytest.mark.parametrize(
    ("chunk", "words"),
    [
        (np.zeros(DIM), r"got an array of shape \(5,\)"),
        (np.zeros((0, DIM)), r"shape \(0, 5\)"),
        (np.full((HORIZON, DIM), np.nan), "with nan or inf"),
        (np.full((HORIZON, DIM), 1e4), "beyond what FAST writes"),
    ],
)
def test_chunks_that_cannot_be_written(tokenizer, chunk, words):
    with pytest.raises(DataError, match=words):
        tokenizer.encode_actions(chunk)


def test_a_tokenizer_that_lacks_bytes_says_so(tokenizer, tmp_path):
    tokenizer.save_pretrained(tmp_path)
    file = tmp_path / "tokenizer.json"
    table = json.loads(file.read_text())
    vocabulary = table["model"]["vocab"]
    written = chr(0x115)  # the byte 0x15
    kept = [token for token in vocabulary if written not in token]
    table["model"]["vocab"] = {token: i for i, token in enumerate(kept)}
    table["model"]["merges"] = [m for m in table["model"]["merges"] if written not in "".join(m)]
    file.write_text(json.dumps(table))
    odd = np.full((1, 1), (0x15 + tokenizer.min_token) / tokenizer.scale)
    with pytest.raises(DataError, match="has no token for some of the chunk's coefficients"):
        FastTokenizer(str(tmp_path)).encode_actions(odd)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (None, "no processor_config.json: it is not the folder of a FAST tokenizer"),
        ({"scale": 0, "min_token": 0}, "scale 0 and min_token 0 must be"),
        ({"scale": 10}, "min_token None"),
        ({"scale": 10, "min_token": 0.5}, "min_token 0.5"),
    ],
)
def test_folders_of_something_else(tokenizer, tmp_path, settings, words):
    tokenizer.save_pretrained(tmp_path)
    (tmp_path / "processor_config.json").unlink()
    if settings is not None:
        (tmp_path / "processor_config.json").write_text(json.dumps(settings))
    with pytest.raises(ConfigError, match=words):
        FastTokenizer(str(tmp_path))
    with pytest.raises(ConfigError, match="does not exist"):
        FastTokenizer(str(tmp_path / "nowhere"))


def test_fitting_to_what_does_not_fit(tmp_path):
    with pytest.raises(ConfigError, match="vocab_size 100 is too small: coefficients from"):
        fit(chunks(10), tmp_path, vocab_size=100)
    with pytest.raises(DataError, match="no chunk to fit"):
        fit([], tmp_path)
    with pytest.raises(ConfigError, match="scale must be above 0"):
        fit(chunks(1), tmp_path, scale=0)
    assert not list(tmp_path.iterdir())
