"""PI0-FAST (Pertsch et al. 2025, arXiv 2501.09747): PaliGemma that answers with action tokens.

The state stands in the prompt. A chunk of actions is an answer in FAST tokens, one after the other:
images and prompt attend to each other, the answer to them and to what it has said already. There
is no action expert, and nothing is denoised.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from fluxvla_models.fast_tokenizer import FastTokenizer
from fluxvla_models.folded_attention import folded_mask
from fluxvla_models.widths import check_actions
from torch import Tensor, nn
from torch.nn import functional

from fluxvla_core import build_tokenizer_from_cfg
from fluxvla_core.errors import ConfigError
from fluxvla_core.models import VLA, InputSizes, built_without_memory, has_values
from fluxvla_pi.action_tokens import ActionWords
from fluxvla_pi.gemma import LINEAR_LAYERS, GemmaDecoder, rope_of
from fluxvla_pi.paligemma import Prefix, embed_prefix, rope_positions
from fluxvla_pi.siglip import SiglipVisionTower
from fluxvla_pi.sizes import gemma_size, image_side, siglip_size

Cache = list[tuple[Tensor, Tensor]]


class PI0FAST(VLA, nn.Module):
    """A vision-language model whose answer is a chunk of actions.

    Args:
        tokenizer: a table of ``fluxvla.tokenizers``, ``FastTokenizer``: the one of the dataset's
            ``ProcessActionTokens``.
        variant: size of the language model: ``gemma_2b``, or a table as ``sizes.GemmaSize``.
        vision_variant: size of the vision tower, ``so400m``, or a table as ``sizes.SiglipSize``.
        n_action_steps, action_dim: actions in a chunk, and the width of one, without padding.
        words: a table as ``ActionWords``, where the text tokenizer is not PaliGemma's.
        max_decoding_steps: the answer's tokens behind its first one; what is not said by then is
            missing.
        temperature: of sampling; 0 takes the likeliest token.
        strict_decoding: see ``FastTokenizer.decode_actions``.
        bos_in_prompt: when acting, images and prompt attend to the answer's first token, which
            they do not in training: as LeRobot's PI0-FAST acts.
        tied_head: the words that are answered are those that are embedded, as in PaliGemma; False
            trains both, as LeRobot does.
        vocab_size: words of the language model.
        freeze_vision_backbone: do not train the vision tower and its projector.
        freeze_llm_backbone: do not train the language model and its head.
        pretrained_name_or_path: what a training starts from, as ``runner.init_from`` takes it.

    Raises:
        ConfigError: sizes that do not belong together, or no folder of a FAST tokenizer.
    """

    input_sizes = InputSizes(
        image_size=("vision_variant", image_side),
        actions="action_dim",
        horizon="n_action_steps",
        vocabulary="vocab_size",
        float_images=True,
    )

    def __init__(
        self,
        tokenizer: Mapping[str, Any],
        variant: str | Mapping[str, int] = "gemma_2b",
        vision_variant: str | Mapping[str, int] = "so400m",
        n_action_steps: int = 50,
        action_dim: int = 7,
        words: Mapping[str, Any] | None = None,
        max_decoding_steps: int = 256,
        temperature: float = 0.0,
        strict_decoding: bool = False,
        bos_in_prompt: bool = False,
        tied_head: bool = True,
        vocab_size: int = 257152,
        freeze_vision_backbone: bool = False,
        freeze_llm_backbone: bool = False,
        pretrained_name_or_path: str | None = None,
    ) -> None:
        super().__init__()
        self.pretrained_name_or_path = pretrained_name_or_path
        llm, vision = gemma_size(variant, "variant"), siglip_size(vision_variant, "vision_variant")
        if min(n_action_steps, action_dim, max_decoding_steps) < 1 or not temperature >= 0:
            raise ConfigError(
                f"n_action_steps {n_action_steps}, action_dim {action_dim} and max_decoding_steps "
                f"{max_decoding_steps} must be at least 1, temperature {temperature} at least 0"
            )
        self.words = ActionWords.of(words, "PI0FAST")
        if self.words.vocab_size > vocab_size:
            raise ConfigError(
                f"PI0FAST: the text tokenizer has {self.words.vocab_size} words (words.vocab_size)"
                f", the language model {vocab_size} (vocab_size)"
            )
        self._table = tokenizer
        self._tokenizer: FastTokenizer | None = None
        if not built_without_memory():  # now rather than when the first answer has been given
            self._action_tokenizer()
        self.n_action_steps, self.action_dim = n_action_steps, action_dim
        self.max_decoding_steps, self.temperature = max_decoding_steps, temperature
        self.strict_decoding, self.bos_in_prompt = strict_decoding, bos_in_prompt
        self.vision_backbone = SiglipVisionTower(vision)
        self.projector = nn.Linear(vision.width, llm.width)
        self.llm_backbone = GemmaDecoder(llm, vocab_size)
        self.lm_head = None if tied_head else nn.Linear(llm.width, vocab_size, bias=False)
        if freeze_vision_backbone:
            self.vision_backbone.requires_grad_(False)
            self.projector.requires_grad_(False)
        if freeze_llm_backbone:
            self.llm_backbone.requires_grad_(False)
            if self.lm_head is not None:
                self.lm_head.requires_grad_(False)

    @property
    def action_shape(self) -> tuple[int, int]:
        """``(T, D)`` of a chunk."""
        return self.n_action_steps, self.action_dim

    @property
    def lora_defaults(self) -> dict[str, Any]:
        """Every linear layer of the language model."""
        return {"target_modules": rf"llm_backbone\.layers\.\d+\.{LINEAR_LAYERS}"}

    def fsdp_units(self) -> list[nn.Module]:
        """The layers of the vision tower and of the language model."""
        return [*self.vision_backbone.layers, *self.llm_backbone.layers]

    def forward(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        action_tokens: Tensor,
        action_token_masks: Tensor,
        img_masks: Tensor | None = None,
        actions: Tensor | Sequence[Any] | None = None,
    ) -> dict[str, Tensor]:
        """One training batch -> ``{"loss": scalar, "sample_losses": (B,)}``.

        The loss is the cross entropy of the answer's tokens behind its first one: the mean over a
        sample's tokens, and over samples, as in openpi. (LeRobot takes one mean over all tokens of
        a batch, which depends on what else is in the batch.)

        Args:
            images: ``(B, 3N, H, W)`` in -1..1.
            lang_tokens, lang_masks: ``(B, L)`` int64 and bool.
            action_tokens, action_token_masks: ``(B, M)`` int64 and bool, of
                ``ProcessActionTokens``.
            img_masks: ``(B, N)``, False for a camera that is not there.
            actions: ``(B, T, D)``, or a list of ``(T, D)``, what the action tokens say; only the
                shape is looked at.

        Raises:
            ConfigError: ``actions`` of another shape than the model's chunks.
        """
        if actions is not None:
            check_actions(type(self).__name__, tuple(actions[0].shape), self.action_shape)
        prefix = self._prefix(images, img_masks, lang_tokens, lang_masks)
        said, real = action_tokens[:, :-1], action_token_masks[:, :-1].bool()
        hidden, real = self._joined(prefix.hidden, prefix.real, said, real)
        places = torch.arange(hidden.shape[1], device=hidden.device)
        # All of the prefix is one block; each token of the answer is one of its own.
        blocks = (places - prefix.hidden.shape[1] + 1).clamp(min=0)
        hidden, _ = self._layers(hidden, rope_positions(real), _mask(blocks, real))
        logits = self._logits(hidden[:, -said.shape[1] :])
        wanted, counted = action_tokens[:, 1:], action_token_masks[:, 1:].float()
        losses = functional.cross_entropy(
            logits.flatten(0, 1), wanted.flatten(), reduction="none"
        ).view_as(counted)
        each = (losses * counted).sum(1) / counted.sum(1).clamp(min=1)
        return {"loss": each.mean(), "sample_losses": each.detach()}

    def predict_action(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        img_masks: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> Tensor:
        """Observation -> normalised actions ``(B, T, D)`` float32.

        Args:
            noise: ``(B, T, D)``, from which the sampling of a ``temperature`` above 0 follows.

        Raises:
            ConfigError: a ``temperature`` above 0 without ``noise``.
        """
        batch = len(images)
        if not has_values(images):
            return images.new_empty((batch, *self.action_shape), dtype=torch.float32)
        answers = self.answer(images, lang_tokens, lang_masks, img_masks, noise)
        tokenizer = self._action_tokenizer()
        chunks = [
            torch.from_numpy(
                tokenizer.decode_actions(
                    self.words.read(answer), *self.action_shape, self.strict_decoding
                )
            )
            for answer in answers.tolist()
        ]
        return torch.stack(chunks).to(images.device, torch.float32)

    def answer(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        img_masks: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> Tensor:
        """The answer's tokens ``(B, n)`` int64 behind its first one; arguments as of
        :meth:`predict_action`.

        It ends when every row has said ``stop``, at ``max_decoding_steps`` otherwise. The keys and
        values of what is known are kept.
        """
        draws = self._draws(noise)
        prefix = self._prefix(images, img_masks, lang_tokens, lang_masks)
        token = lang_tokens.new_full((len(images), 1), self.words.bos)
        one = torch.ones_like(token, dtype=torch.bool)
        hidden, real = self._joined(prefix.hidden, prefix.real, token, one)
        blocks = torch.zeros(hidden.shape[1], dtype=torch.long, device=hidden.device)
        if not self.bos_in_prompt:
            blocks[-1] = 1
        hidden, known = self._layers(hidden, rope_positions(real), _mask(blocks, real))
        groups, dtype = self.llm_backbone.layers[0].groups, prefix.hidden.dtype
        ended, said = torch.zeros_like(one[:, 0]), []
        for step in range(self.max_decoding_steps):
            logits = self._logits(hidden[:, -1])
            token = self._choose(logits, None if draws is None else draws[:, step, None])
            said.append(token)
            ended = ended | (token[:, 0] == self.words.stop)
            if bool(ended.all()):
                break
            real = torch.cat([real, one], dim=1)
            mask = folded_mask(real[:, None, None], groups, dtype)
            hidden = self.llm_backbone.embed(token).to(dtype)
            hidden, known = self._layers(hidden, rope_positions(real)[:, -1:], mask, known)
        return torch.cat(said, dim=1)

    def _prefix(
        self, images: Tensor, img_masks: Tensor | None, lang_tokens: Tensor, lang_masks: Tensor
    ) -> Prefix:
        parts = (self.vision_backbone, self.projector, self.llm_backbone)
        return embed_prefix(*parts, images, img_masks, lang_tokens, lang_masks)

    def _joined(
        self, hidden: Tensor, real: Tensor, tokens: Tensor, more: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Embedded ``hidden`` ``(B, P, W)`` with ``tokens`` ``(B, S)`` behind, and which of them
        are ``real``, of the tokens ``more``."""
        words = self.llm_backbone.embed(tokens).to(hidden.dtype)
        return torch.cat([hidden, words], dim=1), torch.cat([real, more], dim=1)

    def _layers(
        self, hidden: Tensor, positions: Tensor, mask: Tensor, known: Cache | None = None
    ) -> tuple[Tensor, Cache]:
        """The last layer's answer ``(B, S, W)``, normalised, and keys and values of all layers.

        Args:
            hidden: ``(B, S, W)``; positions: ``(B, S)``.
            mask: of ``S`` tokens, ``(B, 1, S, S)`` bool; of one that follows ``known`` ones, a
                folded one.
            known: keys and values of what comes before.
        """
        rope = rope_of(positions, self.llm_backbone.size.head_dim)
        found: Cache = []
        for number, layer in enumerate(self.llm_backbone.layers):
            before = (None, None) if known is None else known[number]
            hidden, keys, values = layer(hidden, rope, mask, *before, folded=known is not None)
            if known is not None:
                keys = torch.cat([known[number][0], keys], dim=2)
                values = torch.cat([known[number][1], values], dim=1)
            found.append((keys, values))
        normed, _ = self.llm_backbone.norm(hidden)
        return normed, found

    def _logits(self, hidden: Tensor) -> Tensor:
        """``(..., W)`` -> ``(..., vocab_size)`` float32."""
        if self.lm_head is not None:
            return self.lm_head(hidden).float()
        return functional.linear(hidden, self.llm_backbone.embed_tokens.weight).float()

    def _choose(self, logits: Tensor, draw: Tensor | None) -> Tensor:
        """The next tokens ``(B, 1)`` of ``logits`` ``(B, V)``; ``draw`` ``(B, 1)`` in 0..1."""
        if draw is None:
            return logits.argmax(-1, keepdim=True)
        shares = (logits.double() / self.temperature).softmax(-1).cumsum(-1)
        place = torch.searchsorted(shares, draw.to(logits.device) * shares[:, -1:], right=True)
        return place.clamp(max=logits.shape[-1] - 1)

    def _draws(self, noise: Tensor | None) -> Tensor | None:
        """``(B, max_decoding_steps)`` float64 in 0..1, each row by its own noise; None if the
        likeliest token is taken."""
        if self.temperature == 0:
            return None
        if noise is None:
            raise ConfigError(
                f"temperature is {self.temperature}: sampling needs noise, which is not given"
            )
        rows = []
        for row in noise.cpu().float().contiguous():
            digest = hashlib.blake2b(row.numpy().tobytes(), digest_size=7).digest()
            generator = torch.Generator().manual_seed(int.from_bytes(digest, "little"))
            rows.append(
                torch.rand(self.max_decoding_steps, generator=generator, dtype=torch.float64)
            )
        return torch.stack(rows)

    def _action_tokenizer(self) -> FastTokenizer:
        if self._tokenizer is None:
            built = build_tokenizer_from_cfg(self._table)
            if not isinstance(built, FastTokenizer):
                raise ConfigError(
                    f"PI0FAST: the tokenizer is a {type(built).__name__}, which knows no actions",
                    next="tokenizer=dict(type='FastTokenizer', model_path=FOLDER)",
                )
            self.words.check(built.vocab_size, "PI0FAST")
            self._tokenizer = built
        return self._tokenizer


def _mask(blocks: Tensor, real: Tensor) -> Tensor:
    """``(B, 1, L, L)``: tokens attend to real ones whose block is not behind their own.

    Padding does so, too: nobody attends to it, and a row without any key has no softmax.
    """
    return real[:, None, None] & (blocks[None, :] <= blocks[:, None])
