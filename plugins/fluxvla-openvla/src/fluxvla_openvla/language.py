"""The language model, and how prompts, images and actions stand in its sequence.

The sequence is: first token, images (and what else is projected), the rest of the prompt,
actions. Padding stands between the images and the rest of the prompt, so that the last token of
every prompt is followed at once by the actions. It is masked out, and positions count without it:
the published models, whose padding follows at the end, compute the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from fluxvla_openvla.sizes import LanguageSize


@dataclass(frozen=True)
class Prompt:
    """``first`` ``(B, 1)`` and ``rest`` ``(B, L)`` int64, padded on the left; ``mask`` ``(B, L)``
    bool is True on real tokens of ``rest``."""

    first: Tensor
    rest: Tensor
    mask: Tensor


def make_llama(size: LanguageSize) -> nn.Module:
    """transformers' ``LlamaForCausalLM`` with new weights."""
    from transformers import LlamaConfig, LlamaForCausalLM

    return LlamaForCausalLM(
        LlamaConfig(
            vocab_size=size.vocab_size,
            hidden_size=size.hidden_size,
            intermediate_size=size.intermediate_size,
            num_hidden_layers=size.num_hidden_layers,
            num_attention_heads=size.num_attention_heads,
            num_key_value_heads=size.num_key_value_heads,
            rms_norm_eps=size.rms_norm_eps,
            max_position_embeddings=size.max_position_embeddings,
            rope_parameters={"rope_type": "default", "rope_theta": size.rope_theta},
            attn_implementation="sdpa",
        )
    )


def split_prompt(tokens: Tensor, masks: Tensor) -> Prompt:
    """Split off the first real token and move the others to the right end.

    Args:
        tokens, masks: ``(B, L)``, padded on either side.
    """
    real = masks.bool()
    first = real & (real.cumsum(1) == 1)
    rest = real & ~first
    order = torch.argsort(rest.long(), dim=1, stable=True)
    begin = (tokens * first).sum(1, keepdim=True)
    return Prompt(begin, tokens.gather(1, order)[:, 1:], rest.gather(1, order)[:, 1:])


def attention_mask(real: Tensor, causal: bool) -> Tensor:
    """Who attends to whom: ``(B, S)`` bool, True on real tokens -> ``(B, 1, S, S)`` bool.

    Args:
        causal: only to itself and to what stands before it; else to all real tokens.
    """
    length = real.shape[1]
    seen = real[:, None, None, :].expand(-1, 1, length, -1)
    if not causal:
        return seen
    return seen & torch.ones(length, length, dtype=torch.bool, device=real.device).tril()


def positions(real: Tensor) -> Tensor:
    """``(B, S)`` bool -> ``(B, S)`` int64: 0, 1, … over real tokens."""
    return (real.long().cumsum(1) - 1).clamp(min=0)


def hidden_states(llama: nn.Module, embeddings: Tensor, real: Tensor, causal: bool) -> Tensor:
    """The last layer's output, after its norm.

    Args:
        embeddings: ``(B, S, width)``; real: ``(B, S)`` bool.
        causal: see ``attention_mask``.

    Returns:
        ``(B, S, width)``.
    """
    output = llama.model(
        inputs_embeds=embeddings,
        attention_mask=attention_mask(real, causal),
        position_ids=positions(real),
        use_cache=False,
    )
    return output.last_hidden_state


def decode(
    llama: nn.Module, embeddings: Tensor, real: Tensor, count: int, first: int, last: int
) -> Tensor:
    """Greedy decoding of ``count`` tokens with a key/value cache.

    Args:
        embeddings: ``(B, S, width)`` of what comes before; real: ``(B, S)`` bool.
        first, last: only tokens from ``first`` up to, not including, ``last`` are chosen.

    Returns:
        ``(B, count)`` int64.
    """
    from transformers import DynamicCache

    cache, found = DynamicCache(), []
    mask, places = attention_mask(real, causal=True), positions(real)
    for _ in range(count):
        states = llama.model(
            inputs_embeds=embeddings,
            attention_mask=mask,
            position_ids=places,
            past_key_values=cache,
            use_cache=True,
        ).last_hidden_state
        token = llama.lm_head(states[:, -1:])[..., first:last].argmax(-1) + first
        found.append(token)
        real = torch.cat([real, torch.ones_like(real[:, :1])], 1)
        mask, places = real[:, None, None, :], places[:, -1:] + 1
        embeddings = llama.model.embed_tokens(token)
    return torch.cat(found, 1)
