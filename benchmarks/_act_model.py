"""ACT, the action-chunking transformer, for ``end_to_end.py``: ``fluxvla run --plugin`` this file.

Written from Zhao et al. 2023 ("Learning Fine-Grained Bimanual Manipulation with Low-Cost
Hardware", arXiv 2304.13705, sections IV and appendix C) in the size that LeRobot's ``act`` has by
default; ``_act_agreement.py`` compares both with equal weights. What is faster here than there
leaves loss and gradients as they are:

- frozen batch norms are part of their convolutions' weights;
- attention gives no weights back;
- of the last layer of the action encoder only the one token that is used goes on;
- actions beyond an episode's end, which neither the action encoder's attention nor the loss sees,
  are not computed (``skip_padding``; False computes them all).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from fluxvla_core import VLAS


class FrozenConv(nn.Conv2d):
    """A convolution followed by a batch norm that training does not change."""

    scale: Tensor
    shift: Tensor

    def __init__(self, inputs: int, outputs: int, size: int, stride: int = 1) -> None:
        super().__init__(inputs, outputs, size, stride, size // 2, bias=False)
        nn.init.kaiming_normal_(self.weight, mode="fan_out", nonlinearity="relu")
        self.register_buffer("scale", torch.ones(outputs))
        self.register_buffer("shift", torch.zeros(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """``(B, inputs, H, W)`` -> ``(B, outputs, H', W')``."""
        weight = self.weight * self.scale[:, None, None, None]
        return F.conv2d(x, weight, self.shift, self.stride, self.padding)


class BasicBlock(nn.Module):
    """Two convolutions with a shortcut (He et al. 2015, figure 5 left)."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = FrozenConv(inputs, outputs, 3, stride)
        self.conv2 = FrozenConv(outputs, outputs, 3)
        self.shortcut = FrozenConv(inputs, outputs, 1, stride) if stride > 1 else None

    def forward(self, x: Tensor) -> Tensor:
        """``(B, inputs, H, W)`` -> ``(B, outputs, H / stride, W / stride)``."""
        out = self.conv2(F.relu_(self.conv1(x)))
        return F.relu_(out.add_(x if self.shortcut is None else self.shortcut(x)))


class ResNet18(nn.Module):
    """Images to a feature map of a 32nd of their size (He et al. 2015, table 1)."""

    channels = 512

    def __init__(self) -> None:
        super().__init__()
        self.stem = FrozenConv(3, 64, 7, 2)
        shapes = [(64, 64, 1), (64, 64, 1), (64, 128, 2), (128, 128, 1)]
        shapes += [(128, 256, 2), (256, 256, 1), (256, 512, 2), (512, 512, 1)]
        self.blocks = nn.Sequential(*(BasicBlock(*shape) for shape in shapes))

    def forward(self, x: Tensor) -> Tensor:
        """``(B, 3, H, W)`` -> ``(B, 512, H / 32, W / 32)``."""
        x = F.max_pool2d(F.relu_(self.stem(x)), 3, 2, 1)
        out: Tensor = self.blocks(x)
        return out


@dataclass(frozen=True)
class Tokens:
    """Where the rows ``(M, W)`` of a batch's tokens belong in ``(B, N)``.

    ``kept``: ``(B, N)``, the tokens that have a row; None for all. ``seen``: ``(B, N)``, those that
    others attend to; None for all.
    """

    batch: int
    count: int
    kept: Tensor | None = None
    seen: Tensor | None = None

    def spread(self, rows: Tensor, heads: int) -> Tensor:
        """``(M, W)`` -> ``(B, heads, N, W / heads)``, zeros where there is no row."""
        if self.kept is not None:
            places = self.kept.flatten().nonzero()[:, 0]
            empty = rows.new_zeros(self.batch * self.count, rows.shape[1])
            rows = empty.index_copy(0, places, rows)
        return rows.view(self.batch, self.count, heads, -1).transpose(1, 2)

    def rows(self, spread: Tensor) -> Tensor:
        """The inverse of :meth:`spread`."""
        found = spread.transpose(1, 2).flatten(2)
        return found.flatten(0, 1) if self.kept is None else found[self.kept]

    @property
    def mask(self) -> Tensor | None:
        """``(B, 1, 1, N)`` for attention to these."""
        return None if self.seen is None else self.seen[:, None, None]


class Attention(nn.Module):
    """Queries and keys with their places added; values without."""

    def __init__(self, width: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.heads, self.dropout = heads, dropout
        self.query, self.key, self.value, self.out = (nn.Linear(width, width) for _ in range(4))

    def forward(self, query: Tensor, key: Tensor, value: Tensor, to: Tokens, of: Tokens) -> Tensor:
        """``(Q, W)``, ``(K, W)``, ``(K, W)`` -> ``(Q, W)``; ``to`` are the queries' tokens."""
        q = to.spread(self.query(query), self.heads)
        k, v = of.spread(self.key(key), self.heads), of.spread(self.value(value), self.heads)
        dropout = self.dropout if self.training else 0.0
        found = F.scaled_dot_product_attention(q, k, v, of.mask, dropout)
        out: Tensor = self.out(to.rows(found))
        return out


class FeedForward(nn.Module):
    def __init__(self, width: int, inner: int, dropout: float) -> None:
        super().__init__()
        self.up, self.down = nn.Linear(width, inner), nn.Linear(inner, width)
        self.dropout = dropout

    def forward(self, x: Tensor) -> Tensor:
        """``(M, W)`` -> the same."""
        out: Tensor = self.down(F.dropout(F.relu_(self.up(x)), self.dropout, self.training))
        return out


class Layer(nn.Module):
    """Attention (to itself, and to ``memory`` if there is some) and a feed-forward network.

    Each is added to its input and normalised after (Vaswani et al. 2017).
    """

    def __init__(self, width: int, heads: int, inner: int, dropout: float, memory: bool) -> None:
        super().__init__()
        self.own = Attention(width, heads, dropout)
        self.memory = Attention(width, heads, dropout) if memory else None
        self.feed = FeedForward(width, inner, dropout)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(3 if memory else 2))
        self.dropout = dropout

    def forward(
        self,
        x: Tensor,
        places: Tensor,
        tokens: Tokens,
        only: Tensor | None = None,
        memory: tuple[Tensor, Tensor, Tokens] | None = None,
    ) -> Tensor:
        """``(M, W)``, ``(M, W)``, … -> ``(M, W)``.

        ``only``: ``(B,)``, the one row of each sample that is wanted: ``(B, W)`` then.
        ``memory``: what else is attended to, its places, and its tokens.
        """
        placed = query = x + places
        value, to = x, tokens
        if only is not None:
            x, query, to = x[only], placed[only], Tokens(tokens.batch, 1)
        x = self._join(0, x, self.own(query, placed, value, to, tokens))
        if self.memory is not None and memory is not None:
            seen, seen_places, of = memory
            found = self.memory(x + places, seen + seen_places, seen, to, of)
            x = self._join(1, x, found)
        return self._join(-1, x, self.feed(x))

    def _join(self, which: int, x: Tensor, found: Tensor) -> Tensor:
        out: Tensor = self.norms[which](x + F.dropout(found, self.dropout, self.training))
        return out


@VLAS.register_module()
class BenchACT(nn.Module):
    """A conditional variational autoencoder of action chunks, decoded from images and a pose.

    Args:
        state_dim, action_dim: D.
        chunk: T, actions of a chunk.
        kl_weight: of the divergence in the loss.
        skip_padding: do not compute actions beyond the episode's end.
    """

    def __init__(
        self,
        state_dim: int = 14,
        action_dim: int = 14,
        chunk: int = 100,
        width: int = 512,
        heads: int = 8,
        inner: int = 3200,
        layers: int = 4,
        latent: int = 32,
        dropout: float = 0.1,
        kl_weight: float = 10.0,
        skip_padding: bool = True,
    ) -> None:
        super().__init__()
        self.latent, self.chunk = latent, chunk
        self.kl_weight, self.skip_padding = kl_weight, skip_padding

        def stack(count: int, memory: bool = False) -> nn.ModuleList:
            return nn.ModuleList(Layer(width, heads, inner, dropout, memory) for _ in range(count))

        self.action_encoder = stack(layers)
        self.style = nn.Embedding(1, width)
        self.style_state = nn.Linear(state_dim, width)
        self.style_action = nn.Linear(action_dim, width)
        self.style_latent = nn.Linear(width, 2 * latent)
        self.style_places: Tensor
        self.register_buffer("style_places", places_1d(chunk + 2, width))
        self.backbone = ResNet18()
        self.encoder = stack(layers)
        self.decoder = stack(1, memory=True)
        self.decoder_norm = nn.LayerNorm(width)
        self.state = nn.Linear(state_dim, width)
        self.from_latent = nn.Linear(latent, width)
        self.image_proj = nn.Conv2d(self.backbone.channels, width, 1)
        self.token_places = nn.Embedding(2, width)
        self.queries = nn.Embedding(chunk, width)
        self.head = nn.Linear(width, action_dim)
        for parameter in (*self.encoder.parameters(), *self.decoder.parameters()):
            if parameter.dim() > 1:
                nn.init.xavier_uniform_(parameter)

    def forward(
        self, images: Tensor, states: Tensor, actions: Tensor, action_masks: Tensor
    ) -> dict[str, Tensor]:
        """``(B, 3N, H, W)``, ``(B, D)``, ``(B, T, D)``, ``(B, T)`` -> ``{"loss": scalar}``."""
        seen = action_masks.bool()
        kept = seen if self.skip_padding else torch.ones_like(seen)
        mean, log_variance = self._encode_actions(states, actions, kept, seen)
        latent = mean + torch.randn_like(mean) * (0.5 * log_variance).exp()
        error = (self.decode(images, states, latent, kept) - actions[kept]).abs()
        error = (error * action_masks[kept][:, None]).sum() / actions.numel()
        divergence = 0.5 * (log_variance.exp() + mean.square() - 1 - log_variance)
        return {"loss": error + self.kl_weight * divergence.sum(-1).mean()}

    def _encode_actions(
        self, states: Tensor, actions: Tensor, kept: Tensor, seen: Tensor
    ) -> tuple[Tensor, Tensor]:
        kept, seen = (F.pad(mask, (2, 0), value=True) for mask in (kept, seen))
        tokens = Tokens(*kept.shape, kept if self.skip_padding else None, seen)
        style = self.style.weight.expand(len(states), 1, -1)
        x = torch.cat([style, self.style_state(states)[:, None], self.style_action(actions)], 1)
        x, places = x[kept], self.style_places.expand(len(states), -1, -1)[kept]
        counts = kept.sum(1)
        first = counts.cumsum(0) - counts
        for number, layer in enumerate(self.action_encoder, 1):
            last = number == len(self.action_encoder)
            x = layer(x, places, tokens, first if last else None)
        mean, log_variance = self.style_latent(x).chunk(2, -1)
        return mean, log_variance

    def decode(self, images: Tensor, states: Tensor, latent: Tensor, kept: Tensor) -> Tensor:
        """The actions of ``kept``, ``(B, T)`` with M of them true, as ``(M, D)``."""
        maps = self.image_proj(self.backbone(images.unflatten(1, (-1, 3)).flatten(0, 1)))
        height, width = maps.shape[-2:]
        cameras = images.shape[1] // 3
        patches = maps.flatten(2).unflatten(0, (-1, cameras)).transpose(2, 3).flatten(1, 2)
        x = torch.cat([self.from_latent(latent)[:, None], self.state(states)[:, None], patches], 1)
        seen = Tokens(*x.shape[:2])
        grid = places_2d(height, width, maps.shape[1]).to(maps).repeat(cameras, 1)
        places = torch.cat([self.token_places.weight, grid]).repeat(len(x), 1)
        x = x.flatten(0, 1)
        for layer in self.encoder:
            x = layer(x, places, seen)
        queries = self.queries.weight.expand(len(kept), -1, -1)[kept]
        y = torch.zeros_like(queries)
        skipped = kept if self.skip_padding else None
        for layer in self.decoder:
            tokens = Tokens(*kept.shape, skipped, skipped)
            y = layer(y, queries, tokens, memory=(x, places, seen))
        out: Tensor = self.head(self.decoder_norm(y))
        return out

    def predict_action(self, images: Tensor, states: Tensor, **_: Any) -> Tensor:
        """Normalised actions ``(B, T, D)`` at the mean of the prior."""
        every = torch.ones(len(states), self.chunk, dtype=torch.bool, device=states.device)
        prior = states.new_zeros(len(states), self.latent)
        return self.decode(images, states, prior, every).unflatten(0, every.shape)

    def fsdp_units(self) -> list[nn.Module]:
        """The transformers' layers and the image's blocks."""
        layers = (*self.action_encoder, *self.encoder, *self.decoder)
        return [*layers, *self.backbone.blocks]


def places_1d(count: int, width: int) -> Tensor:
    """Sines and cosines in turns, ``(count, width)`` (Vaswani et al. 2017, section 3.5)."""
    rates = 10000.0 ** (-2 * (torch.arange(width, dtype=torch.float64) // 2) / width)
    angles = torch.arange(count)[:, None] * rates
    return torch.where(torch.arange(width) % 2 == 0, angles.sin(), angles.cos()).float()


def places_2d(height: int, width: int, channels: int) -> Tensor:
    """Rows in the first half of the channels, columns in the second: ``(height * width, C)``.

    Counted from 1 to the last, which is a whole turn (Carion et al. 2020, DETR's published form).
    """
    rates = 10000.0 ** (-2 * (torch.arange(channels // 2) // 2) / (channels // 2))

    def turns(count: int) -> Tensor:
        angles = torch.arange(1, count + 1) / (count + 1e-6) * 2 * math.pi
        angles = angles[:, None] * rates
        return torch.where(torch.arange(channels // 2) % 2 == 0, angles.sin(), angles.cos())

    rows = turns(height)[:, None].expand(-1, width, -1)
    columns = turns(width)[None].expand(height, -1, -1)
    return torch.cat([rows, columns], -1).flatten(0, 1)
