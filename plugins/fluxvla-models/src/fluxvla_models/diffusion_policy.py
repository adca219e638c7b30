"""Diffusion Policy with a convolutional network (Chi et al. 2023, arXiv 2303.04137).

A network learns to take noise from a chunk of actions, given what is seen. Numbers equal those of
LeRobot's implementation.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from fluxvla_core.errors import ConfigError
from fluxvla_core.models import VLA, InputSizes, PartWeights
from fluxvla_models.conditional_unet import ConditionalUNet
from fluxvla_models.diffusion_schedule import DiffusionSchedule
from fluxvla_models.keypoint_encoder import KeypointEncoder
from fluxvla_models.resnet import published
from fluxvla_models.widths import check_states


class DiffusionPolicy(VLA, nn.Module):
    """Images and joint state in, action chunk out.

    Nothing is drawn in the model: noise, steps and the places of crops come in with the batch, and
    the noise that DDPM adds on its way back follows from the noise that it starts from.

    Args:
        state_dim, action_dim: joints; horizon: actions in a chunk, a multiple of
            ``2 ** len(down_dims)``.
        num_cameras: images per sample.
        n_obs_steps: observations that a chunk is made from, the present one last; the paper has 2.
            Those before come from the dataset's ``n_obs_steps``, and in acting from the runner. A
            chunk begins with the action of the first of them, so that the dataset's
            ``past_actions`` is one less, and as many of its actions are not executed.
        backbone, backbone_norm, backbone_width: see ``ResNet``. ``batch`` is for checkpoints that
            were trained so; their statistics stay as they are.
        backbone_weights: a file with torchvision's weights of ``backbone``, that every encoder of a
            training starts from; nothing is fetched.
        separate_encoders: each camera has its own encoder.
        keypoints: of each encoder. resize_shape, crop_shape: see ``KeypointEncoder``.
        down_dims, kernel_size, n_groups, diffusion_step_embed_dim, use_film_scale_modulation: see
            ``ConditionalUNet``.
        noise_scheduler_type, num_train_timesteps, num_inference_steps, beta_schedule, beta_start,
            beta_end, prediction_type: see ``DiffusionSchedule``.
        clip_sample_range: what estimates are clipped to while acting, so that actions have to be
            normalised to it; None: they are not clipped.
        masked_mean: the loss is a mean over the actions of the episode only; else over all, also
            those that repeat the last action beyond the end. With it the mean of two processes'
            losses is not the whole batch's where chunks go beyond an episode's end.
        pretrained_name_or_path: where a training starts from, as ``runner.init_from``.
    """

    input_sizes = InputSizes(
        cameras="num_cameras",
        states="state_dim",
        actions="action_dim",
        horizon="horizon",
        n_obs_steps="n_obs_steps",
        past_actions=("n_obs_steps", lambda steps: steps - 1),
        float_images=True,
    )

    def __init__(
        self,
        state_dim: int = 14,
        action_dim: int = 14,
        horizon: int = 64,
        num_cameras: int = 1,
        n_obs_steps: int = 1,
        backbone: str = "resnet18",
        backbone_norm: str = "group",
        backbone_width: int = 64,
        backbone_weights: str | None = None,
        separate_encoders: bool = False,
        keypoints: int = 32,
        resize_shape: Sequence[int] | None = None,
        crop_shape: Sequence[int] | None = None,
        down_dims: Sequence[int] = (512, 1024, 2048),
        kernel_size: int = 5,
        n_groups: int = 8,
        diffusion_step_embed_dim: int = 128,
        use_film_scale_modulation: bool = True,
        noise_scheduler_type: str = "DDPM",
        num_train_timesteps: int = 100,
        num_inference_steps: int | None = None,
        beta_schedule: str = "squaredcos_cap_v2",
        beta_start: float = 0.0001,
        beta_end: float = 0.02,
        prediction_type: str = "epsilon",
        clip_sample_range: float | None = 1.0,
        masked_mean: bool = False,
        pretrained_name_or_path: str | None = None,
    ) -> None:
        super().__init__()
        self.pretrained_name_or_path = pretrained_name_or_path
        factor = 2 ** len(down_dims)
        if horizon < 1 or horizon % factor:
            raise ConfigError(
                f"DiffusionPolicy: horizon {horizon} is not a multiple of {factor}: time is "
                f"halved {len(down_dims)} times by down_dims {tuple(down_dims)}",
                next=f"horizon {-(-max(horizon, 1) // factor) * factor}, or fewer down_dims",
            )
        if not 1 <= n_obs_steps <= horizon:
            raise ConfigError(
                f"DiffusionPolicy: n_obs_steps {n_obs_steps} is not between 1 and horizon "
                f"{horizon}: a chunk begins at the first observation and goes beyond the last",
                next="n_obs_steps=2, as in the paper",
            )
        self.schedule = DiffusionSchedule(
            noise_scheduler_type,
            num_train_timesteps,
            num_inference_steps,
            beta_schedule,
            beta_start,
            beta_end,
            prediction_type,
            clip_sample_range,
        )
        self.horizon, self.action_dim, self.num_cameras = horizon, action_dim, num_cameras
        self.n_obs_steps, self.masked_mean = n_obs_steps, masked_mean
        self.rgb_encoders = nn.ModuleList(
            KeypointEncoder(
                backbone, backbone_norm, backbone_width, keypoints, resize_shape, crop_shape
            )
            for _ in range(num_cameras if separate_encoders else 1)
        )
        self.part_weights: tuple[PartWeights, ...] = ()
        if backbone_weights is not None:
            inside = [f"rgb_encoders.{i}.backbone." for i in range(len(self.rgb_encoders))]
            self.part_weights = (published(backbone_weights, inside, backbone_norm),)
        self.state_dim = state_dim
        seen = state_dim + 2 * keypoints * num_cameras
        self.unet = ConditionalUNet(
            action_dim,
            n_obs_steps * seen,
            down_dims,
            kernel_size,
            n_groups,
            diffusion_step_embed_dim,
            use_film_scale_modulation,
        )

    def batch_keys(self) -> Mapping[str, bool]:
        needed = ("images", "states", "actions", "action_masks", "noise", "timesteps")
        return {**dict.fromkeys(needed, True), "crops": False}

    def forward(
        self,
        images: Tensor,
        states: Tensor,
        actions: Tensor,
        action_masks: Tensor,
        noise: Tensor,
        timesteps: Tensor,
        crops: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """One training batch -> ``{"loss": scalar, "sample_losses": (B,)}``, a squared error.

        Args:
            images: ``(B, 3N, H, W)``, states: ``(B, S)``, actions: ``(B, T, D)``, normalised. With
                several observations ``(B, n_obs_steps, 3N, H, W)``, ``(B, n_obs_steps, S)``.
            action_masks: ``(B, T)``, 0 before the beginning and beyond the end of an episode.
            noise: ``(B, K, T, D)`` standard normal, timesteps: ``(B, K)`` int64, crops: ``(B, 2)``
                in 0..1: K draws for each sample, of ``SampleDiffusionNoise``.

        Raises:
            ConfigError: a batch of another shape.
        """
        shape = (self.horizon, self.action_dim)
        if actions.shape[1:] != shape or noise.shape[2:] != shape:
            raise ConfigError(
                f"DiffusionPolicy: actions are {tuple(actions.shape[1:])}, noise "
                f"{tuple(noise.shape[1:])}, the model's chunk is {shape}",
                next="train_dataloader.dataset.action_window_size is the model's horizon, "
                "and action_dim the robot's",
            )
        draws = noise.shape[1]
        condition = self._condition(images, states, crops if self.training else None)
        clean = actions.repeat_interleave(draws, 0)
        eps, steps = noise.flatten(0, 1), timesteps.flatten()
        noisy = self.schedule.add_noise(clean, eps, steps)
        found = self.unet(noisy, steps, condition.repeat_interleave(draws, 0))
        errors = (found - (eps if self.schedule.prediction == "epsilon" else clean)).square()
        if self.masked_mean:
            inside = action_masks.bool().repeat_interleave(draws, 0)
            # The same denominator for each sample, so that their mean is the loss.
            share = inside.float().mean().clamp(min=1 / inside.numel())
            errors = errors * inside[..., None] / share
        losses = errors.reshape(len(actions), -1).mean(1)
        return {"loss": losses.mean(), "sample_losses": losses.detach()}

    def predict_action(
        self,
        images: Tensor,
        states: Tensor,
        noise: Tensor,
        step_noise: Tensor | None = None,
    ) -> Tensor:
        """Observations and ``noise`` ``(B, T, D)`` -> normalised actions ``(B, T, D)``.

        The first ``past_actions`` belong to the earlier observations.

        Args:
            step_noise: ``(B, steps - 1, T, D)``, what DDPM adds on its way; by default it follows
                from ``noise``, sample by sample.
        """
        seen = self.observe(images, states, noise, step_noise)
        return self.denoise(seen, noise, self.step_tables())

    def observe(
        self, images: Tensor, states: Tensor, noise: Tensor, step_noise: Tensor | None = None
    ) -> dict[str, Tensor]:
        """What the steps need: ``condition`` ``(B, C)`` and, for DDPM, ``step_noise``."""
        seen = {"condition": self._condition(images, states, None)}
        added = self.schedule.count - 1
        if self.schedule.kind == "DDPM" and added:
            seen["step_noise"] = following(noise, added) if step_noise is None else step_noise
        return seen

    def denoise(
        self, seen: Mapping[str, Tensor], noise: Tensor, tables: Mapping[str, Tensor]
    ) -> Tensor:
        """All steps from ``noise`` ``(B, T, D)`` to normalised actions ``(B, T, D)``."""
        # Of the kind and the strides that later steps have: others are compiled apart.
        x = noise.clone(memory_format=torch.contiguous_format)
        added = seen.get("step_noise")
        for place in range(self.schedule.count):
            step = tables["steps"][place].expand(len(x), -1)
            output = self.unet.at_step(x, step, seen["condition"])
            last = place == self.schedule.count - 1
            drawn = None if added is None or last else added[:, place]
            x = self.schedule.step(output, x, tables["coefficients"][place], drawn)
        return x

    def step_tables(self) -> dict[str, Tensor]:
        """``steps`` ``(count, C)``, embeddings, and the schedule's ``coefficients``."""
        device = next(self.parameters()).device
        steps = torch.tensor(self.schedule.timesteps, device=device)
        return {
            "steps": self.unet.diffusion_step_encoder(steps),
            "coefficients": self.schedule.coefficients().to(device),
        }

    @property
    def observe_is_capturable(self) -> bool:
        """Not where noise of DDPM's steps is drawn, which happens on the host."""
        return self.schedule.kind == "DDIM" or self.schedule.count == 1

    @property
    def action_shape(self) -> tuple[int, int]:
        """``(T, D)`` of a chunk, and of the noise that one starts from."""
        return self.horizon, self.action_dim

    @property
    def past_actions(self) -> int:
        """A chunk begins with the action of the first observation."""
        return self.n_obs_steps - 1

    def fsdp_units(self) -> list[nn.Module]:
        """Blocks to shard one by one."""
        stages = [stage for encoder in self.rgb_encoders for stage in encoder.backbone.stages]
        return [*stages, *self.unet.fsdp_units()]

    def _condition(self, images: Tensor, states: Tensor, crops: Tensor | None) -> Tensor:
        """The U-Net's condition ``(B, n_obs_steps * (S + features))``."""
        steps = self.n_obs_steps
        if steps == 1 and states.ndim == 2:
            images, states = images[:, None], states[:, None]
        if states.ndim != 3 or states.shape[1] != steps:
            raise ConfigError(
                f"DiffusionPolicy: n_obs_steps is {steps}, states are {tuple(states.shape)}",
                next="the dataset's n_obs_steps is the model's",
            )
        check_states("DiffusionPolicy", "state_dim", states, self.state_dim)
        batch, _, planes = images.shape[:3]
        if planes != 3 * self.num_cameras:
            raise ConfigError(
                f"DiffusionPolicy: num_cameras is {self.num_cameras}, the batch has {planes} "
                f"image channels ({planes // 3} cameras)",
                next="num_cameras is the number of img_keys",
            )
        views = images.reshape(batch * steps, self.num_cameras, 3, *images.shape[3:])
        places = None if crops is None else crops.repeat_interleave(steps, 0)
        if len(self.rgb_encoders) > 1:
            found = [
                encoder(views[:, camera], places)
                for camera, encoder in enumerate(self.rgb_encoders)
            ]
            features = torch.cat(found, dim=-1)
        else:
            each = None if places is None else places.repeat_interleave(self.num_cameras, 0)
            features = self.rgb_encoders[0](views.flatten(0, 1), each)
        seen = features.reshape(batch, steps, -1)
        return torch.cat([states, seen], dim=-1).flatten(1)


def following(noise: Tensor, count: int) -> Tensor:
    """More noise, ``(B, count, T, D)``, that follows from each sample's ``noise`` ``(B, T, D)``.

    A generator is keyed by the digest of the sample's own noise, so that an answer depends neither
    on other samples nor on what was drawn before.
    """
    rows = noise.detach().float().cpu().numpy()
    found = np.empty((len(rows), count, *rows.shape[1:]), np.float32)
    for row, out in zip(rows, found, strict=True):
        key = np.frombuffer(hashlib.sha256(row.tobytes()).digest()[:16], np.uint64)
        generator = np.random.Generator(np.random.Philox(key=key))
        out[:] = generator.standard_normal(out.shape, dtype=np.float32)
    return torch.from_numpy(found).to(noise)
