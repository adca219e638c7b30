"""``OpenVLAOFT``: a chunk of continuous actions in one pass of the language model.

Source: Kim, Finn, Liang, "Fine-Tuning Vision-Language-Action Models: Optimizing Speed and Success"
(2025). Their paper speaks of bidirectional attention between actions; their code, which the
published weights were trained with, lets every token attend to every other one, and so does this.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from fluxvla_core.errors import ConfigError
from fluxvla_core.models import InputSizes
from fluxvla_openvla.heads import (
    DiffusionHead,
    L1RegressionHead,
    StateProjector,
    denoise,
    kept_share,
    step_embedding,
)
from fluxvla_openvla.language import Prompt, hidden_states
from fluxvla_openvla.prismatic import Prismatic
from fluxvla_openvla.sizes import HEADS, LanguageSize, TowerSize, vocabulary


class OpenVLAOFT(Prismatic):
    """Images, instruction and joint state in, an action chunk out.

    The defaults are the published LIBERO policies: chunks of 8 actions of 7 dimensions, two
    images, a state of 8 numbers, L1 regression.

    Args:
        horizon, action_dim: of a chunk.
        num_images: images of an observation, the third-person one first.
        state_dim: numbers of the state; 0 for a policy that does not see it.
        head: ``l1`` or ``diffusion``.
        use_film: modulate the vision features by the instruction (OpenVLA-OFT+, for ALOHA).
        image_size: pixels of an image's side.
        dino, siglip, language: sizes, as tables of what differs from OpenVLA-7B's.
        num_train_steps, num_inference_steps: of the diffusion, in training and acting.
        freeze_vision_backbone: do not train the towers that see.
        freeze_llm_backbone: do not train the language model.
        pretrained_name_or_path: a folder that a training starts from, as published or of FluxVLA;
            ``fluxvla openvla-oft`` makes one of OpenVLA's.

    Raises:
        ConfigError: sizes that do not fit together, or an unknown head.
    """

    input_sizes = InputSizes(
        cameras="num_images",
        image_size="image_size",
        states=("state_dim", lambda width: width or None),
        actions="action_dim",
        horizon="horizon",
        vocabulary=("language.vocab_size | language", vocabulary),
        float_images=True,
    )

    def __init__(
        self,
        horizon: int = 8,
        action_dim: int = 7,
        num_images: int = 2,
        state_dim: int = 8,
        head: str = "l1",
        use_film: bool = False,
        image_size: int = 224,
        dino: Mapping[str, Any] | TowerSize | None = None,
        siglip: Mapping[str, Any] | TowerSize | None = None,
        language: Mapping[str, Any] | LanguageSize | None = None,
        num_train_steps: int = 50,
        num_inference_steps: int = 50,
        freeze_vision_backbone: bool = False,
        freeze_llm_backbone: bool = False,
        pretrained_name_or_path: str | None = None,
    ) -> None:
        if head not in HEADS:
            raise ConfigError(f"OpenVLAOFT: head {head!r} is not one of {', '.join(HEADS)}")
        if not 1 <= num_inference_steps <= num_train_steps:
            raise ConfigError(
                f"OpenVLAOFT: num_inference_steps {num_inference_steps} must be between 1 and "
                f"num_train_steps {num_train_steps}"
            )
        super().__init__(
            horizon, action_dim, num_images, image_size, dino, siglip, language, use_film
        )
        self.pretrained_name_or_path = pretrained_name_or_path
        width = self.size.hidden_size
        self.state_dim, self.head = state_dim, head
        self.num_train_steps, self.num_inference_steps = num_train_steps, num_inference_steps
        if state_dim:
            self.proprio_projector = StateProjector(state_dim, width)
        if head == "l1":
            self.action_head: torch.nn.Module = L1RegressionHead(width, action_dim)
        else:
            self.action_head = DiffusionHead(width, action_dim)
            self.noisy_action_projector = StateProjector(1, width)
        self.freeze(freeze_vision_backbone, freeze_llm_backbone)
        # Tokens are not predicted; the weights stay so that published files have a place.
        self.language_model.lm_head.requires_grad_(False)

    def batch_keys(self) -> dict[str, bool]:
        """What ``forward`` takes: the state and the noise only where they are used."""
        keys = {"images": True, "lang_tokens": True, "lang_masks": True, "actions": True}
        keys["action_masks"] = False
        if self.state_dim:
            keys["states"] = True
        if self.head == "diffusion":
            keys |= {"noise": True, "time": True}
        return keys

    @property
    def lora_defaults(self) -> dict[str, Any]:
        """As of ``Prismatic``; the parts that OpenVLA has not are trained as a whole."""
        parts = ("action_head", "proprio_projector", "noisy_action_projector")
        whole = [name for name in parts if hasattr(self, name)]
        return {**super().lora_defaults, "modules_to_save": whole}

    def fsdp_units(self) -> list[Any]:
        """As of ``Prismatic``, and the action head."""
        return [*super().fsdp_units(), self.action_head]

    def forward(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        actions: Tensor,
        action_masks: Tensor | None = None,
        states: Tensor | None = None,
        noise: Tensor | None = None,
        time: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Mean absolute error of the actions, or mean squared error of the noise in them.

        Args:
            images: ``(B, 3N, H, W)`` in -1..1.
            lang_tokens, lang_masks: ``(B, L)`` int64 and bool.
            actions: ``(B, T, D)`` normalised to -1..1.
            action_masks: ``(B, T)``; the errors of actions with 0 count as 0.
            states: ``(B, S)`` normalised to -1..1.
            noise: ``(B, 1, T, D)``; time: ``(B, 1)`` int64, the step 0, 1, … of the diffusion,
                as ``SampleDiffusionSteps`` draws them.

        Returns:
            ``loss``, scalar, and ``sample_losses`` ``(B,)``.

        Raises:
            ConfigError: images, actions or states of another shape.
        """
        self.check_actions(actions)
        prompt = self.read_prompt(images, lang_tokens, lang_masks)
        context = self._context(images, prompt, states)
        if self.head == "l1":
            errors = (self._head(context, prompt) - actions).abs()
        else:
            assert noise is not None
            assert time is not None
            steps, drawn = time[:, 0].long(), noise[:, 0]
            kept = kept_share(self.num_train_steps).to(steps.device)[steps, None, None]
            noised = kept.sqrt() * actions + (1 - kept).sqrt() * drawn
            step = step_embedding(steps, context.shape[2])
            errors = (self._head(context, prompt, noised, step) - drawn).square()
        if action_masks is not None:
            errors = errors * action_masks.unsqueeze(-1)
        return {"loss": errors.mean(), "sample_losses": errors.detach().mean((1, 2))}

    def predict_action(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        states: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> Tensor:
        """Observation, and for diffusion ``noise`` ``(B, T, D)`` -> normalised ``(B, T, D)``."""
        seen = self.observe(images, lang_tokens, lang_masks, states)
        return self.denoise(seen, noise, self.step_tables())

    def observe(
        self,
        images: Tensor,
        lang_tokens: Tensor,
        lang_masks: Tensor,
        states: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Images and state ``context`` ``(B, P, width)``, and the prompt, split."""
        prompt = self.read_prompt(images, lang_tokens, lang_masks)
        context = self._context(images, prompt, states)
        return {"context": context, **vars(prompt)}

    def denoise(
        self, seen: Mapping[str, Tensor], noise: Tensor | None, tables: Mapping[str, Tensor]
    ) -> Tensor:
        """The passes of the language model: one (L1), or one for each step of the diffusion.

        All tokens attend to all others, the noised actions among them, so that nothing of a pass
        can be kept for the next.
        """
        prompt = Prompt(seen["first"], seen["rest"], seen["mask"])
        if self.head == "l1":
            return self._head(seen["context"], prompt)
        assert noise is not None
        for place in range(self.num_inference_steps):
            step = tables["steps"][place].expand(len(noise), -1)
            found = self._head(seen["context"], prompt, noise, step)
            noise = denoise(noise, found, *tables["kept"][place].unbind())
        return noise

    def step_tables(self) -> dict[str, Tensor]:
        """For the diffusion: embedded ``steps`` ``(count, width)``, and of each the share ``kept``
        in it and in the next, ``(count, 2)``."""
        if self.head == "l1":
            return {}
        device = self.language_model.model.embed_tokens.weight.device
        stride = self.num_train_steps // self.num_inference_steps
        steps = torch.arange(self.num_inference_steps - 1, -1, -1) * stride
        kept = torch.cat([kept_share(self.num_train_steps)[steps], torch.ones(1)])
        return {
            "steps": step_embedding(steps.to(device), self.size.hidden_size),
            "kept": torch.stack([kept[:-1], kept[1:]], 1).to(device),
        }

    @property
    def observe_is_capturable(self) -> bool:
        """Whether ``observe`` only launches operations on tensors: it does."""
        return True

    def _context(self, images: Tensor, prompt: Prompt, states: Tensor | None) -> Tensor:
        """Images and state: ``(B, P, width)``."""
        features = self.encode_images(images, prompt)
        if not self.state_dim:
            return features
        if states is None or states.shape[-1] != self.state_dim:
            shape = None if states is None else tuple(states.shape)
            raise ConfigError(
                f"OpenVLAOFT: states have shape {shape}, state_dim is {self.state_dim}",
                cause="the model was made for another robot, or its state is not in the batch",
            )
        return torch.cat([features, self.proprio_projector(states).unsqueeze(1)], 1)

    def _head(
        self,
        context: Tensor,
        prompt: Prompt,
        noised: Tensor | None = None,
        step: Tensor | None = None,
    ) -> Tensor:
        """One pass: actions ``(B, T, D)``, or the noise in ``noised`` ``(B, T, D)``.

        Places of actions hold zeros, or their noised numbers, one a token; ``step`` ``(B, width)``
        says how much noise there is.
        """
        batch, count = len(context), self.horizon * self.action_dim
        places = torch.zeros(
            batch, count, context.shape[2], dtype=context.dtype, device=context.device
        )
        if noised is not None and step is not None:
            places = self.noisy_action_projector(noised.reshape(batch, count, 1))
            context = torch.cat([context, step.to(context.dtype).unsqueeze(1)], 1)
        front = [self.embed(prompt.first), context]
        back = [places, self.embed(self.stop_tokens(batch))]
        embeddings = torch.cat([*front, self.embed(prompt.rest), *back], 1)
        real = torch.ones(embeddings.shape[:2], dtype=torch.bool, device=context.device)
        begin = 1 + context.shape[1]
        real[:, begin : begin + prompt.mask.shape[1]] = prompt.mask
        states = hidden_states(self.language_model, embeddings, real, causal=False)
        # As with tokens, an action's numbers are read at the places before them.
        states = states[:, -(count + 2) : -2]
        return self.action_head(states.reshape(batch, self.horizon, -1))
