"""ACT, the Action Chunking Transformer (Zhao et al. 2023, arXiv 2304.13705).

A conditional variational autoencoder: in training an encoder compresses the demonstrated chunk to
a latent, from which, with images and joint state, a transformer decodes the chunk; to act, the
latent is the prior's mean, zero. Numbers equal those of LeRobot's implementation.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from fluxvla_core.errors import ConfigError
from fluxvla_core.models import VLA, InputSizes, PartWeights
from fluxvla_models.resnet import ResNet, published
from fluxvla_models.transformer import Decoder, Encoder, positions_1d, positions_2d
from fluxvla_models.widths import check_states


class ACT(VLA, nn.Module):
    """Images and joint state in, action chunk out.

    Only dropout is drawn in the model: the latent's noise comes in with the batch. A loss depends
    on the number of processes while ``dropout`` is above 0.

    Args:
        state_dim, action_dim: joints; horizon: actions in a chunk.
        num_cameras: images per sample, all seen by the same network.
        backbone, backbone_norm, backbone_width: see ``ResNet``. ``frozen_batch`` is meant for
            weights trained on ImageNet; ``group`` for training from nothing.
        backbone_weights: a file with torchvision's weights of ``backbone``, that a training starts
            from; nothing is fetched.
        dim_model, n_heads, dim_feedforward, feedforward_activation, pre_norm, dropout,
        n_encoder_layers, n_decoder_layers: of the transformer. The authors' code uses one decoder
            layer, whatever its setting.
        use_vae, latent_dim, n_vae_encoder_layers: of the encoder of chunks.
        kl_weight: of the divergence from the prior in the loss.
        masked_mean: the loss is a mean over the actions of the episode only, as in LeRobot from
            0.6 on; else over all, those beyond the end counting as zero, as in the authors' code
            and LeRobot before. With it the mean of two processes' losses is not the whole
            batch's where chunks go beyond an episode's end.
        pretrained_name_or_path: where a training starts from, as ``runner.init_from``.
    """

    input_sizes = InputSizes(
        cameras="num_cameras",
        states="state_dim",
        actions="action_dim",
        horizon="horizon",
        float_images=True,
    )

    def __init__(
        self,
        state_dim: int = 14,
        action_dim: int = 14,
        horizon: int = 100,
        num_cameras: int = 1,
        backbone: str = "resnet18",
        backbone_norm: str = "frozen_batch",
        backbone_width: int = 64,
        backbone_weights: str | None = None,
        dim_model: int = 512,
        n_heads: int = 8,
        dim_feedforward: int = 3200,
        feedforward_activation: str = "relu",
        pre_norm: bool = False,
        dropout: float = 0.1,
        n_encoder_layers: int = 4,
        n_decoder_layers: int = 1,
        use_vae: bool = True,
        latent_dim: int = 32,
        n_vae_encoder_layers: int = 4,
        kl_weight: float = 10.0,
        masked_mean: bool = False,
        pretrained_name_or_path: str | None = None,
    ) -> None:
        super().__init__()
        self.pretrained_name_or_path = pretrained_name_or_path
        if dim_model % n_heads or dim_model % 4:
            raise ConfigError(
                f"ACT: dim_model {dim_model} must be a multiple of n_heads {n_heads} and of 4, "
                "for the sines and cosines of rows and columns"
            )
        self.state_dim = state_dim
        self.horizon, self.action_dim, self.num_cameras = horizon, action_dim, num_cameras
        self.use_vae, self.latent_dim = use_vae, latent_dim
        self.kl_weight, self.masked_mean = kl_weight, masked_mean
        size = (dim_model, n_heads, dim_feedforward)
        more = {
            "dropout": dropout,
            "activation": feedforward_activation,
            "pre_norm": pre_norm,
        }
        if use_vae:
            self.vae_encoder = Encoder(n_vae_encoder_layers, *size, **more)
            self.vae_encoder_cls_embed = nn.Embedding(1, dim_model)
            self.vae_encoder_robot_state_input_proj = nn.Linear(state_dim, dim_model)
            self.vae_encoder_action_input_proj = nn.Linear(action_dim, dim_model)
            self.vae_encoder_latent_output_proj = nn.Linear(dim_model, 2 * latent_dim)
        self.backbone = ResNet(backbone, backbone_norm, backbone_width)
        self.part_weights: tuple[PartWeights, ...] = ()
        if backbone_weights is not None:
            self.part_weights = (published(backbone_weights, ["backbone."], backbone_norm),)
        self.encoder = Encoder(n_encoder_layers, *size, **more)
        self.decoder = Decoder(n_decoder_layers, *size, **more)
        self.encoder_robot_state_input_proj = nn.Linear(state_dim, dim_model)
        self.encoder_latent_input_proj = nn.Linear(latent_dim, dim_model)
        self.encoder_img_feat_input_proj = nn.Conv2d(self.backbone.out_channels, dim_model, 1)
        self.encoder_1d_feature_pos_embed = nn.Embedding(2, dim_model)
        self.decoder_pos_embed = nn.Embedding(horizon, dim_model)
        self.action_head = nn.Linear(dim_model, action_dim)
        for part in (self.encoder, self.decoder):
            for parameter in part.parameters():
                if parameter.ndim > 1:
                    nn.init.xavier_uniform_(parameter)

    def batch_keys(self) -> Mapping[str, bool]:
        keys = dict.fromkeys(("images", "states", "actions", "action_masks"), True)
        return {**keys, "latent_noise": self.use_vae}

    def forward(
        self,
        images: Tensor,
        states: Tensor,
        actions: Tensor,
        action_masks: Tensor,
        latent_noise: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """One training batch -> ``{"loss": scalar, "sample_losses": (B,)}``.

        Mean absolute error, and ``kl_weight`` times the latent's divergence from the prior. In
        evaluation mode the latent is zero, as it is when the model acts.

        Args:
            images: ``(B, 3N, H, W)``, states: ``(B, S)``, actions: ``(B, T, D)``, normalised.
            action_masks: ``(B, T)``, 0 beyond the end of an episode.
            latent_noise: ``(B, latent_dim)`` standard normal, of ``SampleLatentNoise``.

        Raises:
            ConfigError: a batch of another shape, or no ``latent_noise``.
        """
        if actions.shape[1:] != (self.horizon, self.action_dim):
            raise ConfigError(
                f"ACT: actions are {tuple(actions.shape[1:])}, the model's are "
                f"{(self.horizon, self.action_dim)}",
                next="train_dataloader.dataset.action_window_size is the model's horizon, "
                "and action_dim the robot's",
            )
        inside = action_masks.bool()
        latent, divergence = states.new_zeros(len(states), self.latent_dim), None
        if self.use_vae and self.training:
            latent, divergence = self._encode(states, actions, inside, latent_noise)
        found = self._decode(images, states, latent)
        errors = (found - actions).abs() * inside[..., None]
        losses = errors.mean((1, 2))
        if self.masked_mean:
            # The same denominator for each sample, so that their mean is the loss.
            share = inside.float().mean()
            losses = losses / share.clamp(min=1 / inside.numel())
        if divergence is not None:
            losses = losses + self.kl_weight * divergence
        return {"loss": losses.mean(), "sample_losses": losses.detach()}

    def predict_action(self, images: Tensor, states: Tensor) -> Tensor:
        """``images`` ``(B, 3N, H, W)`` and ``states`` ``(B, S)`` -> actions ``(B, T, D)``."""
        return self._decode(images, states, states.new_zeros(len(states), self.latent_dim))

    @property
    def action_shape(self) -> tuple[int, int]:
        """``(T, D)`` of a chunk."""
        return self.horizon, self.action_dim

    def fsdp_units(self) -> list[nn.Module]:
        """Blocks to shard one by one."""
        units = [*self.backbone.stages, *self.encoder.layers, *self.decoder.layers]
        return [*units, *self.vae_encoder.layers] if self.use_vae else units

    def _encode(
        self, states: Tensor, actions: Tensor, inside: Tensor, noise: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """A sample of the latent ``(B, L)`` and its divergence from the prior ``(B,)``."""
        check_states("ACT", "state_dim", states, self.state_dim)
        batch = len(states)
        if noise is None or noise.shape != (batch, self.latent_dim):
            got = "none" if noise is None else f"one of shape {tuple(noise.shape)}"
            raise ConfigError(
                f"ACT needs latent_noise of shape {(batch, self.latent_dim)}, got {got}",
                next=f"dict(type='SampleLatentNoise', dim={self.latent_dim}) in the dataset's "
                "transforms, and 'latent_noise' in the collator's keys",
            )
        tokens = torch.cat(
            [
                self.vae_encoder_cls_embed.weight[None].expand(batch, -1, -1),
                self.vae_encoder_robot_state_input_proj(states)[:, None],
                self.vae_encoder_action_input_proj(actions),
            ],
            dim=1,
        )
        positions = positions_1d(tokens.shape[1], tokens.shape[2], tokens.device)
        ignored = torch.cat([inside.new_zeros(batch, 2), ~inside], dim=1)
        first = self.vae_encoder(tokens, positions, ignored)[:, 0]
        mean, log_variance = self.vae_encoder_latent_output_proj(first).chunk(2, dim=-1)
        divergence = -0.5 * (1 + log_variance - mean.square() - log_variance.exp()).sum(-1)
        return mean + (log_variance / 2).exp() * noise, divergence

    def _decode(self, images: Tensor, states: Tensor, latent: Tensor) -> Tensor:
        """The chunk ``(B, T, D)``."""
        check_states("ACT", "state_dim", states, self.state_dim)
        batch, planes = images.shape[:2]
        if planes != 3 * self.num_cameras:
            raise ConfigError(
                f"ACT: num_cameras is {self.num_cameras}, the batch has {planes} image channels "
                f"({planes // 3} cameras)",
                next="num_cameras is the number of img_keys",
            )
        maps = self.backbone(images.reshape(batch * self.num_cameras, 3, *images.shape[2:]))
        features = self.encoder_img_feat_input_proj(maps)
        width, rows, columns = features.shape[1:]
        pixels = features.reshape(batch, self.num_cameras, width, rows * columns)
        seen = pixels.transpose(2, 3).reshape(batch, -1, width)
        place = positions_2d(rows, columns, width, images.device).to(seen.dtype)
        where = torch.cat(
            [self.encoder_1d_feature_pos_embed.weight[None], place.repeat(1, self.num_cameras, 1)],
            dim=1,
        )
        tokens = torch.cat(
            [
                self.encoder_latent_input_proj(latent)[:, None],
                self.encoder_robot_state_input_proj(states)[:, None],
                seen,
            ],
            dim=1,
        )
        memory = self.encoder(tokens, where)
        queries = self.decoder_pos_embed.weight[None]
        empty = torch.zeros_like(queries).expand(batch, -1, -1)
        return self.action_head(self.decoder(empty, memory, queries, where))
