"""``OpenVLA``: actions as tokens of a vision-language model, one after the other.

Source: Kim et al., "OpenVLA: An Open-Source Vision-Language-Action Model" (2024); section 3.2 has
the tokens: 256 bins over -1..1, the last 256 tokens of the vocabulary. The 256 edges are evenly
spaced, so that there are 255 intervals. A value below the second edge is bin 1, the value 1 itself
bin 256, and bin ``i`` is token ``text_vocab_size - i``. Back from tokens, bins 255 and 256 are the
same interval.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from fluxvla_core.models import InputSizes
from fluxvla_openvla.language import Prompt, decode, hidden_states
from fluxvla_openvla.prismatic import Prismatic
from fluxvla_openvla.sizes import LanguageSize, TowerSize, vocabulary

BINS = 256
_EDGES = np.linspace(-1.0, 1.0, BINS)
_CENTERS = (_EDGES[:-1] + _EDGES[1:]) / 2


class ActionTokens:
    """Between normalised actions and token ids.

    The edges are no buffers of the model: one that is cast to bfloat16 would round them.

    Args:
        text_vocab_size: tokens of the tokenizer, without padding of the embedding.
    """

    def __init__(self, text_vocab_size: int) -> None:
        self.text_vocab_size = text_vocab_size

    @property
    def first(self) -> int:
        """The lowest token id of an action."""
        return self.text_vocab_size - BINS

    def encode(self, actions: Tensor) -> Tensor:
        """Normalised actions of any shape -> token ids int64; what is outside -1..1 is clipped."""
        edges = torch.from_numpy(_EDGES).to(actions.device)
        clipped = actions.double().clamp(-1.0, 1.0)
        return self.text_vocab_size - torch.bucketize(clipped, edges, right=True)

    def decode(self, tokens: Tensor) -> Tensor:
        """Token ids of any shape -> the centres of their bins, float32."""
        bins = (self.text_vocab_size - tokens - 1).clamp(0, BINS - 2)
        return torch.from_numpy(_CENTERS).to(tokens.device, torch.float32)[bins]


class OpenVLA(Prismatic):
    """One image and an instruction in, one action out, as ``action_dim`` tokens.

    The defaults are OpenVLA-7B (7.54 billion parameters).

    Args:
        action_dim: dimensions of an action; each is one token.
        image_size: pixels of an image's side.
        dino, siglip, language: sizes, as tables of what differs from OpenVLA-7B's.
        predict_stop_token: learn the token after the actions too, as OpenVLA does.
        freeze_vision_backbone: do not train the towers that see.
        freeze_llm_backbone: do not train the language model.
        pretrained_name_or_path: a folder that a training starts from, as published or of FluxVLA.

    Raises:
        ConfigError: sizes that do not fit together.
    """

    input_sizes = InputSizes(
        cameras=1,
        image_size="image_size",
        actions="action_dim",
        horizon=1,
        vocabulary=("language.vocab_size | language", vocabulary),
        float_images=True,
    )

    def __init__(
        self,
        action_dim: int = 7,
        image_size: int = 224,
        dino: Mapping[str, Any] | TowerSize | None = None,
        siglip: Mapping[str, Any] | TowerSize | None = None,
        language: Mapping[str, Any] | LanguageSize | None = None,
        predict_stop_token: bool = True,
        freeze_vision_backbone: bool = False,
        freeze_llm_backbone: bool = False,
        pretrained_name_or_path: str | None = None,
    ) -> None:
        super().__init__(1, action_dim, 1, image_size, dino, siglip, language, use_film=False)
        self.pretrained_name_or_path = pretrained_name_or_path
        self.predict_stop_token = predict_stop_token
        self.freeze(freeze_vision_backbone, freeze_llm_backbone)
        self.action_tokens = ActionTokens(self.size.text_vocab_size)

    @property
    def lora_defaults(self) -> dict[str, Any]:
        """As of ``Prismatic``, and the layer that predicts tokens."""
        layers = super().lora_defaults["target_modules"]
        return {"target_modules": rf"{layers}|language_model\.lm_head"}

    def forward(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        actions: Tensor,
        action_masks: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Cross entropy of the action tokens, and of the stop token.

        Args:
            images: ``(B, 3, H, W)`` in -1..1.
            lang_tokens, lang_masks: ``(B, L)`` int64 and bool.
            actions: ``(B, 1, D)`` normalised to -1..1.
            action_masks: ``(B, 1)``; a sample with 0 does not count.

        Returns:
            ``loss``, scalar, and ``sample_losses`` ``(B,)``.

        Raises:
            ConfigError: images or actions of another shape.
        """
        self.check_actions(actions)
        prompt = self.read_prompt(images, lang_tokens, lang_masks)
        tokens = self.action_tokens.encode(actions[:, 0])
        embeddings, real = self._sequence(images, prompt)
        embeddings = torch.cat([embeddings, self.embed(tokens)], 1)
        real = torch.cat([real, torch.ones_like(tokens, dtype=torch.bool)], 1)
        targets = tokens
        if self.predict_stop_token:
            targets = torch.cat([tokens, self.stop_tokens(len(tokens))], 1)
        states = hidden_states(self.language_model, embeddings, real, causal=True)
        # Each token is predicted at the place before it.
        begin = states.shape[1] - self.action_dim - 1
        states = states[:, begin : begin + targets.shape[1]]
        logits = self.language_model.lm_head(states).float()
        losses = functional.cross_entropy(logits.transpose(1, 2), targets, reduction="none").mean(1)
        if action_masks is not None:
            losses = losses * action_masks[:, 0]
        return {"loss": losses.mean(), "sample_losses": losses.detach()}

    def predict_action(self, images: Tensor, lang_tokens: Tensor, lang_masks: Tensor) -> Tensor:
        """Greedy decoding: observation -> normalised action ``(B, 1, D)`` float32.

        Only tokens of actions are chosen. OpenVLA's code takes any token, and clips what is none to
        the outermost bins: an end of text would become the highest action.
        """
        prompt = self.read_prompt(images, lang_tokens, lang_masks)
        embeddings, real = self._sequence(images, prompt)
        tokens = decode(
            self.language_model,
            embeddings,
            real,
            self.action_dim,
            self.action_tokens.first,
            self.size.text_vocab_size,
        )
        return self.action_tokens.decode(tokens).unsqueeze(1)

    def _sequence(self, images: Tensor, prompt: Prompt) -> tuple[Tensor, Tensor]:
        """Embeddings ``(B, S, width)`` of images and prompt, and which of them are real."""
        features = self.encode_images(images, prompt)
        embeddings = torch.cat([self.embed(prompt.first), features, self.embed(prompt.rest)], 1)
        front = torch.ones(
            len(features), 1 + features.shape[1], dtype=torch.bool, device=features.device
        )
        return embeddings, torch.cat([front, prompt.mask], 1)
