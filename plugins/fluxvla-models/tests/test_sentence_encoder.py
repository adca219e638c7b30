"""The sentence encoder takes models that are data."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest
import torch
from fluxvla_models.sentence_encoder import MINILM, SentenceEncoder

from fluxvla_core.data import resolve_model_path
from fluxvla_core.errors import ConfigError


def test_code_that_comes_with_a_model_is_not_run(tmp_path: Path) -> None:
    config = json.loads((resolve_model_path(MINILM) / "config.json").read_text())
    config["auto_map"] = {"AutoConfig": "evil.Config", "AutoModel": "evil.Model"}
    config["model_type"] = "evil"
    (tmp_path / "config.json").write_text(json.dumps(config))
    (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    with pytest.raises(ConfigError, match="auto_map") as caught:
        SentenceEncoder(str(tmp_path))
    assert caught.value.exit_code == 2
    assert not (tmp_path / "ran").exists()
    assert not [name for name in sys.modules if name.endswith("evil")]


@pytest.mark.parametrize("damage", [b"", b"\x00" * 64, b"\xff" * 8 + b"{}"])
def test_weights_that_cannot_be_read_are_named(tmp_path: Path, damage: bytes) -> None:
    shutil.copy(resolve_model_path(MINILM) / "config.json", tmp_path)
    (tmp_path / "model.safetensors").write_bytes(damage)
    with pytest.raises(ConfigError, match=str(tmp_path)):
        SentenceEncoder(str(tmp_path))


def test_it_is_built_and_called_without_memory() -> None:
    with torch.device("meta"):
        bare = SentenceEncoder()
        tokens = torch.ones(3, 8, dtype=torch.long)
        found = bare(tokens, tokens.bool())
    assert {p.device.type for p in bare.parameters()} == {"meta"}
    assert not any(p.requires_grad for p in bare.parameters())
    real = SentenceEncoder()
    shapes = {name: (p.shape, p.dtype) for name, p in real.named_parameters()}
    assert {name: (p.shape, p.dtype) for name, p in bare.named_parameters()} == shapes
    assert (found.shape, found.dtype) == ((3, real.out_dim), torch.float32)


def test_more_tokens_than_it_has_positions_for() -> None:
    tokens = torch.ones(1, 513, dtype=torch.long)
    with pytest.raises(ConfigError, match="has 513 places for tokens, the encoder 512"):
        SentenceEncoder()(tokens, tokens.bool())
