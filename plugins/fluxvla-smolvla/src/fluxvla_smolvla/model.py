"""SmolVLA (Shukor et al. 2025, arXiv 2506.01844), as LeRobot publishes it.

Images, the instruction and a state token go through the first layers of SmolVLM2. An action
expert of narrower layers attends to that model's keys and values, layer by layer, and predicts the
velocity of flow matching. The language model sees nothing of the actions, so its part of a sample
is computed once, however many noise samples or integration steps follow.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from typing import Any

import torch
from fluxvla_models.guidance import Guide
from fluxvla_models.velocity import sample
from fluxvla_models.widths import check_actions, check_prefix_len, check_states
from torch import Tensor, nn

from fluxvla_core.errors import ConfigError
from fluxvla_core.models import VLA, InputSizes
from fluxvla_smolvla.expert import ActionTimeMLP, Expert
from fluxvla_smolvla.sizes import TextSize, VisionSize, expert_size, size_of
from fluxvla_smolvla.transformer import ContextLayer, KVCache, Prefix, RMSNorm, Rotation
from fluxvla_smolvla.vision import Connector, VisionTower, resize_with_pad

LOSSES = ("valid", "all")
SMOLVLM2 = "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"
BLACK = -1.0
"""Normalised value that images are padded with."""


class LanguageModel(nn.Module):
    """The first layers of SmolLM2; ``norm`` is kept for checkpoints, nothing uses it.

    Args:
        size: of all layers.
        deepest: number of the last layer whose keys and values are used.
    """

    def __init__(self, size: TextSize, deepest: int) -> None:
        super().__init__()
        self.size, self.deepest = size, deepest
        self.embed_tokens = nn.Embedding(size.vocabulary, size.hidden_size)
        self.layers = nn.ModuleList(ContextLayer(size) for _ in range(size.layers))
        self.norm = RMSNorm(size.hidden_size, size.rms_norm_eps)

    def forward(self, context: Tensor, mask: Tensor, state: Tensor) -> KVCache:
        """Keys and values of the layers up to the deepest.

        Args:
            context: ``(B, C, width)``; ``mask``: ``(B, C)`` bool, False on padding.
            state: ``(B, 1, width)``.
        """
        count = mask.sum(1)
        head_dim = self.size.head_dim
        prefix = Prefix(
            mask=mask[:, None, None],
            context=Rotation.at(mask.long().cumsum(1) - 1, head_dim),
            state=Rotation.at(count[:, None], head_dim),
        )
        keys, values = [], []
        for number, layer in enumerate(self.layers[: self.deepest + 1]):
            last = number == self.deepest
            context, state, key, value = layer(context, state, prefix, last)
            keys.append(key)
            values.append(value)
        cache_mask = nn.functional.pad(prefix.mask, (0, 1), value=True)
        return KVCache(tuple(keys), tuple(values), cache_mask, count + 1)


def _vocabulary(text: int | TextSize | Mapping[str, Any] | None) -> int:
    """Of a table of sizes; it may be the number itself."""
    return text if isinstance(text, int) else size_of(TextSize, text).vocabulary


class SmolVLA(VLA, nn.Module):
    """Images, instruction and joint state in, action chunk out; 450 million parameters.

    ``forward`` and ``predict_action`` draw nothing: noise and times come in with the batch.

    Args:
        vision, text: sizes of the vision tower and of the language model; SmolVLM2-500M's.
        n_action_steps: actions in a chunk.
        max_state_dim, max_action_dim: widths of states and actions, padded with zeros.
        ori_action_dim: dimensions of the robot's action; the loss leaves out the padding behind
            them. None counts all.
        num_steps: Euler steps at inference.
        num_expert_layers: layers of the expert; as many as the language model's if None.
        self_attn_every_n_layers: see ``Expert``; 1 never crosses.
        expert_width_multiplier: the expert's width, of the language model's.
        min_period, max_period: of the sinusoids that stand for the time.
        freeze_vision_encoder: do not train the vision tower.
        train_expert_only: train neither the tower, nor the connector, nor the language model.
        train_state_proj: train the layer that makes the state token.
        loss_mean: ``valid``, as LeRobot: the mean over the steps that are inside their episodes;
            ``all``: steps beyond the end count as 0, which several processes, each with its own
            share of a batch, compute exactly as one process does.
        prefix_conditioning: chunks that continue another are trained for and made by holding their
            beginning (Black et al. 2025, arXiv 2512.05964); without, they are made by guidance.
            Training takes ``prefix_len`` of ``SamplePrefixLength`` then.
        vlm_model_name: the backbone's name on the hub, which LeRobot looks up; for exports.
        pretrained_name_or_path: weights that a training starts from, as ``runner.init_from``.

    Raises:
        ConfigError: sizes that do not go together.
    """

    input_sizes = InputSizes(
        states="max_state_dim",
        actions="max_action_dim",
        horizon="n_action_steps",
        vocabulary=("text.vocabulary | text", _vocabulary),
        float_images=True,
    )

    def __init__(
        self,
        vision: VisionSize | Mapping[str, Any] | None = None,
        text: TextSize | Mapping[str, Any] | None = None,
        n_action_steps: int = 50,
        max_state_dim: int = 32,
        max_action_dim: int = 32,
        ori_action_dim: int | None = None,
        num_steps: int = 10,
        num_expert_layers: int | None = None,
        self_attn_every_n_layers: int = 2,
        expert_width_multiplier: float = 0.75,
        min_period: float = 4e-3,
        max_period: float = 4.0,
        freeze_vision_encoder: bool = True,
        train_expert_only: bool = True,
        train_state_proj: bool = True,
        loss_mean: str = "valid",
        prefix_conditioning: bool = False,
        vlm_model_name: str = SMOLVLM2,
        pretrained_name_or_path: str | None = None,
    ) -> None:
        super().__init__()
        vision_size, text_size = size_of(VisionSize, vision), size_of(TextSize, text)
        experts = text_size.layers if num_expert_layers is None else num_expert_layers
        _check_counts(
            experts,
            text_size.layers,
            n_action_steps=n_action_steps,
            num_steps=num_steps,
            max_state_dim=max_state_dim,
            max_action_dim=max_action_dim,
        )
        if ori_action_dim is not None and not 1 <= ori_action_dim <= max_action_dim:
            raise ConfigError(
                f"SmolVLA: ori_action_dim {ori_action_dim} is not in 1..{max_action_dim} "
                "(max_action_dim)"
            )
        if loss_mean not in LOSSES:
            raise ConfigError(f"SmolVLA: loss_mean {loss_mean!r} is not one of {', '.join(LOSSES)}")
        self.n_action_steps, self.num_steps, self.loss_mean = n_action_steps, num_steps, loss_mean
        self.max_state_dim, self.max_action_dim = max_state_dim, max_action_dim
        self.ori_action_dim = max_action_dim if ori_action_dim is None else ori_action_dim
        self.prefix_conditioning = prefix_conditioning
        self.image_size, self.width = vision_size.image_size, text_size.hidden_size
        self.pretrained_name_or_path = pretrained_name_or_path
        size = expert_size(text_size, experts, expert_width_multiplier)
        self.vision = VisionTower(vision_size)
        self.connector = Connector(vision_size, text_size.hidden_size)
        stride = text_size.layers // experts
        self.text = LanguageModel(text_size, deepest=(experts - 1) * stride)
        # Of no use here; kept so that a checkpoint goes back to LeRobot as it came.
        self.lm_head = nn.Linear(text_size.hidden_size, text_size.vocabulary, bias=False)
        self.state_proj = nn.Linear(max_state_dim, text_size.hidden_size)
        self.embed_actions = ActionTimeMLP(max_action_dim, size.hidden_size, min_period, max_period)
        self.expert = Expert(size, stride, self_attn_every_n_layers)
        self.action_out_proj = ExactLinear(size.hidden_size, max_action_dim)
        self.apply(_initialize)
        self._freeze(freeze_vision_encoder, train_expert_only, train_state_proj)

    def forward(
        self,
        images: Tensor,
        img_masks: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        states: Tensor,
        actions: Tensor,
        action_masks: Tensor,
        noise: Tensor,
        time: Tensor,
        prefix_len: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """One training batch -> ``{"loss": scalar, "sample_losses": (B,)}``.

        Args:
            images: ``(B, 3N, H, W)`` in -1..1; of another size than the vision tower's, they are
                resized without distortion.
            img_masks: ``(B, N)`` bool, False for cameras that are not there.
            lang_tokens, lang_masks: ``(B, L)`` int64 and bool.
            states: ``(B, S)`` normalised; ``actions``: ``(B, T, D)`` normalised.
            action_masks: ``(B, T)``, 0 beyond the end of an episode.
            noise: ``(B, K, T, D)``; ``time``: ``(B, K)`` in 0..1, 1 being the data.
            prefix_len: ``(B, K)`` int64: so many actions at the beginning are given, without noise,
                and their errors count as 0, for ``prefix_conditioning``.

        Raises:
            ConfigError: an input of a width that the model does not have; ``prefix_len`` without
                ``prefix_conditioning``, or the reverse.
        """
        check_prefix_len(self.prefix_conditioning, prefix_len)
        repeats = noise.shape[1]
        check_actions("SmolVLA", tuple(actions.shape[1:]), self.action_shape)
        check_actions("SmolVLA", tuple(noise.shape[2:]), self.action_shape, "noise")
        cache = self._encode_prefix(images, img_masks, lang_tokens, lang_masks, states)
        cache = cache.repeat_interleave(repeats)
        t, given = 1.0 - time, None
        if prefix_len is not None:
            given = self._first(prefix_len)
            t = torch.where(given, 0.0, t[..., None])
        share = t[..., None] if t.ndim == 3 else t[..., None, None]
        clean = actions[:, None]
        noisy, target = share * noise + (1.0 - share) * clean, noise - clean
        velocity = self._velocity(noisy.flatten(0, 1), t.flatten(0, 1), cache)
        velocity = velocity.unflatten(0, (-1, repeats))
        errors = (velocity.float() - target).square()
        if given is not None:
            errors = errors * ~given[..., None]
        errors = errors[..., : self.ori_action_dim]
        loss, each = _masked_mean(errors, action_masks, self.loss_mean)
        return {"loss": loss, "sample_losses": each.detach()}

    def predict_action(
        self,
        images: Tensor,
        img_masks: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        states: Tensor,
        noise: Tensor,
        prev_actions: Tensor | None = None,
        prefix_weights: Tensor | None = None,
        prefix_len: Tensor | None = None,
        max_guidance_weight: Tensor | None = None,
    ) -> Tensor:
        """Observation and ``noise`` ``(B, T, D)`` -> normalised actions ``(B, T, D)``.

        Args:
            images, img_masks, lang_tokens, lang_masks, states: as of ``forward``.
            prev_actions: ``(B, T, D)`` normalised, to continue; the other three belong to it, see
                ``fluxvla_models.guidance.Guide``. With ``prefix_conditioning`` ``prefix_len`` rows
                are held, the rest is free.
            prefix_weights: ``(B, T)``; prefix_len, max_guidance_weight: ``(B,)``.

        Raises:
            ConfigError: an input of a width that the model does not have.
        """
        check_actions("SmolVLA", tuple(noise.shape[1:]), self.action_shape, "noise")
        own = None if self.prefix_conditioning else self.ori_action_dim
        guide = Guide.of(prev_actions, prefix_weights, prefix_len, max_guidance_weight, own)
        if guide is None:
            seen = self.observe(images, img_masks, lang_tokens, lang_masks, states)
            return self.denoise(seen, noise, self.step_tables())
        cache = self._encode_prefix(images, img_masks, lang_tokens, lang_masks, states)
        held = guide if self.prefix_conditioning else None

        def velocity(x: Tensor, t: Tensor) -> Tensor:
            if held is not None:
                x = held.freeze(x)
                t = torch.where(self._first(held.frozen), 0.0, t[:, None])
            return self._velocity(x, t, cache).to(x.dtype)

        if held is not None:
            return held.freeze(sample(velocity, noise, self.num_steps))
        return sample(velocity, noise, self.num_steps, guide)

    def observe(
        self,
        images: Tensor,
        img_masks: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        states: Tensor,
    ) -> dict[str, Tensor]:
        """What the steps need of an observation, arguments as of ``forward``: ``Expert.observe``.

        Raises:
            ConfigError: an input of a width that the model does not have.
        """
        cache = self._encode_prefix(images, img_masks, lang_tokens, lang_masks, states)
        return self.expert.observe(cache, self.n_action_steps)

    def denoise(
        self, seen: Mapping[str, Tensor], noise: Tensor, tables: Mapping[str, Tensor]
    ) -> Tensor:
        """All steps by Euler's method: ``noise`` ``(B, T, D)`` -> actions ``(B, T, D)``."""
        check_actions("SmolVLA", tuple(noise.shape[1:]), self.action_shape, "noise")
        x = noise
        for step in range(self.num_steps):
            tokens = self.embed_actions.embed_at_time(x, tables["times"][step])
            x = (
                x
                - self.action_out_proj(self.expert.step(tokens, seen)).to(x.dtype) / self.num_steps
            )
        return x

    def step_tables(self) -> dict[str, Tensor]:
        """``times`` ``(K, W)``: sinusoidal features of the time of every step."""
        times = torch.tensor([1.0 - step / self.num_steps for step in range(self.num_steps)])
        return {"times": self.embed_actions.time_features(times.to(self.state_proj.weight.device))}

    @property
    def observe_is_capturable(self) -> bool:
        """It reads nothing back to the host."""
        return True

    def exact_modules(self) -> list[nn.Module]:
        """The velocity is computed in fp32."""
        return [self.action_out_proj]

    @property
    def action_shape(self) -> tuple[int, int]:
        """``(T, D)`` of a chunk, and of the noise that one starts from."""
        return self.n_action_steps, self.max_action_dim

    @property
    def lora_defaults(self) -> dict[str, Any]:
        """The expert's attention and the layers around it."""
        return {
            "target_modules": (
                r"expert\.layers\.\d+\.self_attn\.[qv]_proj|state_proj|action_out_proj"
                r"|embed_actions\.(action_in_proj|action_time_mlp_(in|out))"
            )
        }

    def fsdp_units(self) -> list[nn.Module]:
        """The layers of the vision tower, of the language model and of the expert."""
        return [*self.vision.layers, *self.text.layers, *self.expert.layers]

    def _encode_prefix(
        self, images: Tensor, img_masks: Tensor, tokens: Tensor, masks: Tensor, states: Tensor
    ) -> KVCache:
        """The KV cache of images, instruction and state."""
        cameras, rest = divmod(images.shape[1], 3)
        if rest or cameras != img_masks.shape[1]:
            raise ConfigError(
                f"SmolVLA: images have {images.shape[1]} channels, img_masks {img_masks.shape[1]} "
                "cameras; 3 channels each are expected"
            )
        check_states("SmolVLA", "max_state_dim", states, self.max_state_dim)
        features = self._encode_images(images.unflatten(1, (cameras, 3)).flatten(0, 1))
        features = features.unflatten(0, (-1, cameras))
        image_mask = img_masks.bool()[..., None].expand(-1, -1, features.shape[2])
        embeddings = self.text.embed_tokens(tokens)
        context = torch.cat([features.flatten(1, 2), embeddings.to(features.dtype)], dim=1)
        mask = torch.cat([image_mask.flatten(1), masks.bool()], dim=1)
        state = self.state_proj(states)[:, None]
        # LeRobot scales image and text embeddings by the root of their width, but not the state.
        return self.text(context * self.width**0.5, mask, state)

    def _encode_images(self, images: Tensor) -> Tensor:
        """``(B, 3, H, W)`` in -1..1 -> ``(B, tokens, width)``."""
        whole = resize_with_pad(images, self.image_size, self.image_size, BLACK)
        return self.connector(self.vision(whole))

    def _first(self, length: Tensor) -> Tensor:
        """``(..., T)``, True for the first ``length`` ``(...)`` actions of a chunk."""
        return torch.arange(self.n_action_steps, device=length.device) < length[..., None]

    def _velocity(self, noisy: Tensor, t: Tensor, cache: KVCache) -> Tensor:
        return self.action_out_proj(self.expert(self.embed_actions(noisy, t), cache))

    def _freeze(self, vision: bool, expert_only: bool, state_proj: bool) -> None:
        """As LeRobot freezes: what no gradient reaches never trains either.

        Of the deepest layer that the expert attends to, only keys and values are used, and LeRobot
        trains none of it.
        """
        frozen: list[nn.Module] = [self.lm_head, self.text.norm]
        frozen += [self.vision] if vision or expert_only else []
        frozen += [self.connector, self.text] if expert_only else []
        frozen += self.text.layers[self.text.deepest :]
        frozen += [] if state_proj else [self.state_proj]
        for module in frozen:
            module.requires_grad_(False)


class ExactLinear(nn.Linear):
    """A linear layer that computes in fp32 whatever its weights are in, also under autocast.

    For the velocity, which is summed over the steps.
    """

    def forward(self, input: Tensor) -> Tensor:
        """``(..., in_features)`` -> ``(..., out_features)`` in fp32."""
        kind = input.device.type
        with nullcontext() if kind == "meta" else torch.autocast(kind, enabled=False):
            return nn.functional.linear(input.float(), self.weight.float(), self.bias.float())


def _initialize(module: nn.Module) -> None:
    """Normal weights of 0.02, as SmolVLM2 begins; states and actions are projected by torch's."""
    if isinstance(module, (Expert, LanguageModel, VisionTower, Connector)):
        for part in module.modules():
            if isinstance(part, (nn.Linear, nn.Embedding, nn.Conv2d)):
                nn.init.normal_(part.weight, std=0.02)
                if isinstance(part, (nn.Linear, nn.Conv2d)) and part.bias is not None:
                    nn.init.zeros_(part.bias)


def _check_counts(experts: int, layers: int, **counts: int) -> None:
    for name, count in counts.items():
        if count < 1:
            raise ConfigError(f"SmolVLA: {name} {count} must be positive")
    if experts < 1 or layers % experts:
        raise ConfigError(
            f"SmolVLA: num_expert_layers {experts} does not divide the language model's {layers} "
            "layers (text.layers)"
        )


def _masked_mean(errors: Tensor, masks: Tensor, over: str) -> tuple[Tensor, Tensor]:
    """The loss of a batch, and that of each sample, ``(B,)``.

    Args:
        errors: ``(B, K, T, D)``.
        masks: ``(B, T)``, 0 beyond the end of an episode.
        over: ``valid``: the mean over steps inside episodes; ``all``: the others count as 0, so
            that the gradient does not depend on which samples share a batch.
    """
    kept = errors * masks[:, None, :, None]
    if over == "all":
        return kept.mean(), kept.flatten(1).mean(1)
    each = masks.sum(1).to(errors.dtype) * errors.shape[1] * errors.shape[3]
    return kept.sum() / each.sum().clamp_min(1), kept.flatten(1).sum(1) / each.clamp_min(1)
