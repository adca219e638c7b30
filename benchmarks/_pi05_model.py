"""A network of pi0.5's size and shape for ``gpu_step.py``.

Written from the reports, weights random:

- the whole: Black et al. 2024 ("pi0", arXiv 2410.24164, section IV and appendix B) and Physical
  Intelligence 2025 ("pi0.5", arXiv 2504.16054): images, words and the state as words are seen by
  a language model; an action expert with layers of its own attends to it layer by layer, and its
  norms know the time of flow matching;
- PaliGemma (Beyer et al. 2024, arXiv 2407.07726): the vision tower SigLIP So400m/14 (Zhai et al.
  2023, arXiv 2303.15343; shape by Alabdulmohsin et al. 2023, arXiv 2305.13035), one linear map, and
  Gemma-2B (Gemma Team 2024, arXiv 2403.08295, table 1) with 257152 words;
- the adaptive norm: Peebles and Xie 2023 (DiT, arXiv 2212.09748) with RMS norms.

Training by flow matching alone, as fine-tuning does, so nothing reads the language model's last
hidden states: of its last layer only keys and values are computed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from benchmarks._pi05_attention import Places, Seen, attend, first, first_packed
from fluxvla_core import VLAS

EPS = 1e-6
ATTENTION = ("sdpa", "packed")


@dataclass(frozen=True)
class Size:
    """Lengths and widths of everything; images are square, in pixels."""

    cameras: int = 2
    image_size: int = 224
    patch: int = 14
    vision_width: int = 1152
    vision_inner: int = 4304
    vision_layers: int = 27
    vision_heads: int = 16
    words: int = 257152
    prompt: int = 200
    layers: int = 18
    heads: int = 8
    head_width: int = 256
    width: int = 2048
    inner: int = 16384
    expert_width: int = 1024
    expert_inner: int = 4096
    actions: int = 50
    action_dim: int = 32

    @property
    def patches(self) -> int:
        """Of one image."""
        return (self.image_size // self.patch) ** 2

    @property
    def prefix(self) -> int:
        """Tokens before the actions."""
        return self.cameras * self.patches + self.prompt


SIZES = {
    "pi05": Size(),
    "tiny": Size(
        image_size=28,
        vision_width=32,
        vision_inner=48,
        vision_layers=2,
        vision_heads=2,
        words=97,
        prompt=10,
        layers=3,
        heads=4,
        head_width=16,
        width=40,
        inner=56,
        expert_width=24,
        expert_inner=32,
        actions=5,
        action_dim=4,
    ),
}


def exact(x: Tensor) -> torch.autocast:
    """Norms take and give the dtype of ``x``, and compute in fp32 inside their kernel.

    Autocast would have them read and write fp32, which is twice the memory traffic.
    """
    kind = x.device.type
    return torch.autocast("cpu" if kind == "meta" else kind, enabled=False)


class LayerNorm(nn.LayerNorm):
    def forward(self, x: Tensor) -> Tensor:
        """``(…, W)`` -> the same."""
        with exact(x):
            weight, bias = self.weight.to(x.dtype), self.bias.to(x.dtype)
            return F.layer_norm(x, self.normalized_shape, weight, bias, EPS)


class RMSNorm(nn.Module):
    """Gemma's: the weight is kept as its difference from 1."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        """``(…, W)`` -> the same."""
        with exact(x):
            return F.rms_norm(x, self.weight.shape, (1 + self.weight).to(x.dtype), EPS)


class AdaptiveNorm(nn.Module):
    """An RMS norm whose scale and shift, and a gate for what comes after, follow from the time."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.modulate = nn.Linear(width, 3 * width)

    def forward(self, x: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        """``(B, L, W)``, ``(B, W)`` -> ``(B, L, W)`` and a gate ``(B, 1, W)``."""
        scale, shift, gate = self.modulate(time)[:, None].chunk(3, -1)
        with exact(x):
            plain = F.rms_norm(x, x.shape[-1:], None, EPS)
        return plain * (1 + scale) + shift, gate


class VisionBlock(nn.Module):
    """Attention among the patches of an image and an MLP, both normalised before."""

    def __init__(self, size: Size) -> None:
        super().__init__()
        width, self.heads = size.vision_width, size.vision_heads
        self.norms = nn.ModuleList(LayerNorm(width) for _ in range(2))
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.up = nn.Linear(width, size.vision_inner)
        self.down = nn.Linear(size.vision_inner, width)

    def forward(self, x: Tensor) -> Tensor:
        """``(P, patches, W)`` -> the same."""
        qkv = self.qkv(self.norms[0](x)).unflatten(-1, (3, self.heads, -1))
        found = F.scaled_dot_product_attention(*qkv.permute(2, 0, 3, 1, 4))
        x = x + self.out(found.transpose(1, 2).flatten(2))
        return x + self.down(F.gelu(self.up(self.norms[1](x)), approximate="tanh"))


class Parts(nn.Module):
    """The products of one of Gemma's layers: attention with one key and value head, and GeGLU."""

    def __init__(self, size: Size, width: int, inner: int) -> None:
        super().__init__()
        self.heads, self.head_width = size.heads, size.head_width
        joined = size.heads * size.head_width
        self.qkv = nn.Linear(width, joined + 2 * size.head_width, bias=False)
        self.out = nn.Linear(joined, width, bias=False)
        self.up = nn.Linear(width, 2 * inner, bias=False)
        self.down = nn.Linear(inner, width, bias=False)

    def look(self, x: Tensor, places: Places) -> tuple[Tensor, Tensor, Tensor]:
        """``(B, L, W)`` -> query ``(B, L, H, w)``, key and value ``(B, L, w)``."""
        qkv = self.qkv(x).unflatten(-1, (-1, self.head_width))
        query, key, value = qkv.split([self.heads, 1, 1], 2)
        return places.turn(query), places.turn(key)[:, :, 0], value[:, :, 0]

    def feed(self, x: Tensor) -> Tensor:
        """``(B, L, W)`` -> the same."""
        gate, up = self.up(x).chunk(2, -1)
        out: Tensor = self.down(F.gelu(gate, approximate="tanh") * up)
        return out


class LanguageLayer(Parts):
    """A layer of the language model; it gives the expert's layer its keys and values."""

    def __init__(self, size: Size, last: bool) -> None:
        super().__init__(size, size.width, size.inner)
        self.norms = nn.ModuleList(RMSNorm(size.width) for _ in range(2))
        self.last = last

    def forward(self, x: Tensor, places: Places, seen: Seen) -> tuple[Tensor, Tensor, Tensor]:
        """``(B, S, W)`` -> the same, and key and value ``(B, S, w)``."""
        query, key, value = self.look(self.norms[0](x), places)
        if not self.last:
            x = x + self.out(attend(query, key, value, seen))
            x = x + self.feed(self.norms[1](x))
        return x, key, value


class ExpertLayer(Parts):
    """A layer of the action expert, which attends to the language model's of the same number."""

    def __init__(self, size: Size) -> None:
        super().__init__(size, size.expert_width, size.expert_inner)
        self.norms = nn.ModuleList(AdaptiveNorm(size.expert_width) for _ in range(2))

    def forward(
        self, x: Tensor, key: Tensor, value: Tensor, time: Tensor, places: Places, seen: Seen
    ) -> Tensor:
        """``(B, T, W)``, ``(B, S, w)``, ``(B, S, w)``, ``(B, W)`` -> ``(B, T, W)``."""
        found, gate = self.norms[0](x, time)
        query, own_key, own_value = self.look(found, places)
        # Padding is last in what is seen, so its own come first.
        key, value = torch.cat([own_key, key], 1), torch.cat([own_value, value], 1)
        x = x + gate * self.out(attend(query, key, value, seen))
        found, gate = self.norms[1](x, time)
        return x + gate * self.feed(found)


@VLAS.register_module()
class BenchPi05(nn.Module):
    """Images and a prompt to a chunk of actions, by flow matching.

    Args:
        size: a name in ``SIZES``.
        attention: how padding is left out, one of ``ATTENTION``; without a GPU it is ``sdpa``.
        device: where the random weights are made, which takes a GPU a second and a CPU a minute.
    """

    def __init__(self, size: str = "pi05", attention: str = "sdpa", device: str = "cpu") -> None:
        super().__init__()
        if attention not in ATTENTION:
            raise ValueError(f"attention {attention!r} is not one of {', '.join(ATTENTION)}")
        self.size, self.attention = SIZES[size], attention
        with torch.device(device):
            self._build(self.size)

    def _build(self, s: Size) -> None:
        self.patch = nn.Linear(3 * s.patch**2, s.vision_width)
        self.patch_places = nn.Parameter(0.02 * torch.randn(s.patches, s.vision_width))
        self.vision = nn.ModuleList(VisionBlock(s) for _ in range(s.vision_layers))
        self.vision_norm = LayerNorm(s.vision_width)
        self.image_proj = nn.Linear(s.vision_width, s.width)
        self.words = nn.Parameter(torch.randn(s.words, s.width).mul_(s.width**-0.5))
        self.language = nn.ModuleList(LanguageLayer(s, i + 1 == s.layers) for i in range(s.layers))
        self.expert = nn.ModuleList(ExpertLayer(s) for _ in range(s.layers))
        self.expert_norm = AdaptiveNorm(s.expert_width)
        self.time = nn.ModuleList(nn.Linear(s.expert_width, s.expert_width) for _ in range(2))
        self.action_in = nn.Linear(s.action_dim, s.expert_width)
        self.action_out = nn.Linear(s.expert_width, s.action_dim)

    def forward(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        actions: Tensor,
        noise: Tensor,
        time: Tensor,
        lang_masks: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """One batch -> ``{"loss": scalar}``, the mean squared error of the velocity.

        Args:
            images: ``(B, 3N, P, P)`` uint8.
            lang_tokens: ``(B, L)`` int64.
            actions, noise: ``(B, T, D)`` normalised, and standard normal.
            time: ``(B,)`` from 0 (noise) to 1 (actions).
            lang_masks: ``(B, L)``, false for padding, which is last; None: there is none.
        """
        x = self.see(images)
        words = F.embedding(lang_tokens, self.words).to(x.dtype)
        x = torch.cat([x, words * self.size.width**0.5], 1)
        steps = self.action_in(torch.lerp(noise, actions, time[:, None, None])).to(x.dtype)
        condition = self.embed_time(time).to(x.dtype)
        first_places, last_places, *both = self.layout(lang_masks, x)
        for language, expert in zip(self.language, self.expert, strict=True):
            x, key, value = language(x, first_places, both[0])
            steps = expert(steps, key, value, condition, last_places, both[1])
        velocity = self.action_out(self.expert_norm(steps, condition)[0])
        return {"loss": (velocity.float() - (actions - noise)).square().mean()}

    def see(self, images: Tensor) -> Tensor:
        """``(B, 3N, P, P)`` uint8 -> ``(B, N * patches, W)``."""
        side, patch = self.size.image_size // self.size.patch, self.size.patch
        x = images.unflatten(1, (-1, 3)).flatten(0, 1)
        x = x.unflatten(3, (side, patch)).unflatten(2, (side, patch)).permute(0, 2, 4, 1, 3, 5)
        x = self.patch(x.flatten(3).flatten(1, 2).float() / 127.5 - 1)
        x = x + self.patch_places.to(x.dtype)
        for block in self.vision:
            x = block(x)
        return self.image_proj(self.vision_norm(x)).unflatten(0, (len(images), -1)).flatten(1, 2)

    def embed_time(self, time: Tensor) -> Tensor:
        """``(B,)`` -> ``(B, W)``, by way of waves with periods from 4e-3 to 4 (openpi's)."""
        half = self.size.expert_width // 2
        part = torch.arange(half, device=time.device) / (half - 1)
        angles = time[:, None] * (2 * math.pi / 4e-3) * 1e-3**part
        x = torch.cat([angles.sin(), angles.cos()], -1)
        for layer in self.time:
            x = F.silu(layer(x))
        return x

    def layout(self, lang_masks: Tensor | None, x: Tensor) -> tuple[Places, Places, Seen, Seen]:
        """Positions of ``x`` and of the actions, and what each of them sees."""
        s, device = self.size, x.device
        ahead, after = (torch.arange(n, device=device)[None] for n in (s.prefix, s.actions))
        seen = later = Seen()
        counts: int | Tensor = s.prefix
        if lang_masks is not None:
            counts = s.prefix - s.prompt + lang_masks.sum(1)
            whole = s.prefix + s.actions
            # Counting operations on the meta device goes by the mask: the shapes are the same.
            if self.attention == "packed" and device.type == "cuda":
                rows = s.prefix * s.heads
                seen = first_packed(counts, s.prefix, counts * s.heads, rows)
                rows = s.actions * s.heads
                later = first_packed(counts + s.actions, whole, rows, rows)
            else:
                seen, later = first(counts, s.prefix), first(counts + s.actions, whole)
            counts = counts[:, None]
        places = (Places.of(p, s.head_width, x.dtype) for p in (ahead, counts + after))
        return (*places, seen, later)

    def fsdp_units(self) -> list[nn.Module | tuple[nn.Module, ...]]:
        """The vision tower's blocks, and each language layer with the expert's that sees it."""
        return [*self.vision, *zip(self.language, self.expert, strict=True)]
