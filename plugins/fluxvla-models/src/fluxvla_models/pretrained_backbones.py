"""Vision and language models of transformers as backbones, built from a folder's ``config.json``.

Nothing is fetched, and no code that comes with weights is run. A folder is a path, or
``package:<module>/<folder>`` for one that an installed package carries. ``sizes`` are values of its
``config.json``: where they are given, a dry run, or a checkpoint that brings all weights, needs no
folder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from fluxvla_core.errors import ConfigError
from fluxvla_core.models import model_folder as checked_folder
from fluxvla_core.models import weights_follow

Sizes = Mapping[str, Any]
_NO_SIZES = ("architectures", "dtype", "transformers_version")
_REFUSED = ("auto_map", "quantization_config", "attn_implementation", "experts_implementation")


class SigLIPBackbone(nn.Module):
    """SigLIP's image encoder (Zhai et al. 2023): a feature for each patch of each camera.

    Args:
        model_folder: of a ``siglip`` or ``siglip_vision_model``.
        num_cameras: images per sample, all seen by the same encoder.
        pretrained: load the folder's weights; else they are drawn anew, which is right where a
            checkpoint overwrites them.
        sizes: values of the folder's ``config.json``, with its ``model_type``. They are compared
            with it where it is there. Checkpoints hold them.

    Raises:
        ConfigError: there is no such folder, it wants code of its own run, is of another kind or of
            other ``sizes``, or lacks weights.
    """

    def __init__(
        self,
        model_folder: str,
        num_cameras: int = 1,
        pretrained: bool = True,
        sizes: Sizes | None = None,
    ) -> None:
        super().__init__()
        kinds = ("siglip_vision_model", "siglip")
        folder, config = described(model_folder, kinds, pretrained, sizes, "vision_config")
        self.sizes = sizes_of(config)
        config.vision_use_head = False  # it pools all patches into one feature
        from transformers import SiglipVisionModel

        self.model = built(SiglipVisionModel, folder, config, pretrained)
        self.num_cameras = num_cameras
        self.image_size = config.image_size
        self.tokens_per_image = (config.image_size // config.patch_size) ** 2
        self.out_dim: int = config.hidden_size

    def forward(self, images: Tensor) -> Tensor:
        """``(B, 3N, H, W)`` in -1..1 -> ``(B, N * patches, out_dim)``, camera by camera.

        Raises:
            ConfigError: another number of cameras, or another size than the encoder's.
        """
        views = split_views(images, self.num_cameras, self.image_size)
        features = self.model(pixel_values=views).last_hidden_state
        return features.reshape(len(images), -1, self.out_dim)

    def fsdp_units(self) -> list[nn.Module]:
        """Blocks to shard one by one."""
        return layers_of(self.model)


class LanguageBackbone(nn.Module):
    """A decoder-only language model without the layer that predicts words.

    Args:
        model_folder, pretrained, sizes: as of ``SigLIPBackbone``.
        num_layers: use the first ones only; all by default.
    """

    kinds: ClassVar[Sequence[str]] = ()

    def __init__(
        self,
        model_folder: str,
        pretrained: bool = True,
        num_layers: int | None = None,
        sizes: Sizes | None = None,
    ) -> None:
        super().__init__()
        folder, config = described(model_folder, self.kinds, pretrained, sizes)
        self.sizes = sizes_of(config)
        if num_layers is not None:
            if not 1 <= num_layers <= config.num_hidden_layers:
                raise ConfigError(
                    f"num_layers {num_layers} is not between 1 and the model's "
                    f"{config.num_hidden_layers}",
                    where=model_folder,
                )
            config.num_hidden_layers = num_layers
            if config.to_dict().get("layer_types"):
                config.layer_types = config.layer_types[:num_layers]
        from transformers import AutoModel

        self.model = built(AutoModel, folder, config, pretrained)
        self.out_dim: int = config.hidden_size

    def embed(self, tokens: Tensor) -> Tensor:
        """``(B, L)`` int64 -> ``(B, L, out_dim)``."""
        return self.model.get_input_embeddings()(tokens)

    def forward(self, embeddings: Tensor, masks: Tensor) -> Tensor:
        """``(B, L, out_dim)`` and ``masks`` ``(B, L)`` bool -> hidden states ``(B, L, out_dim)``.

        Positions count what the masks leave, so that padding does not matter, on either side.
        """
        positions = (masks.long().cumsum(1) - 1).clamp(min=0)
        output = self.model(
            inputs_embeds=embeddings,
            attention_mask=masks.long(),
            position_ids=positions,
            use_cache=False,
        )
        return output.last_hidden_state

    def fsdp_units(self) -> list[nn.Module]:
        """Blocks to shard one by one."""
        return layers_of(self.model)


class Qwen3Backbone(LanguageBackbone):
    """Qwen3 (arXiv 2505.09388)."""

    kinds = ("qwen3",)


class Qwen2Backbone(LanguageBackbone):
    """Qwen2 and Qwen2.5 (arXiv 2412.15115)."""

    kinds = ("qwen2",)


class LlamaBackbone(LanguageBackbone):
    """Llama 2 and 3 (arXiv 2307.09288, 2407.21783)."""

    kinds = ("llama",)


class PaliGemmaBackbone(nn.Module):
    """PaliGemma (Beyer et al. 2024): image and text tokens in one model, with full attention.

    Args:
        model_folder, num_cameras, pretrained, sizes: as of ``SigLIPBackbone``.
    """

    def __init__(
        self,
        model_folder: str,
        num_cameras: int = 1,
        pretrained: bool = True,
        sizes: Sizes | None = None,
    ) -> None:
        super().__init__()
        folder, config = described(model_folder, ("paligemma",), pretrained, sizes)
        self.sizes = sizes_of(config)
        config.vision_config.vision_use_head = False
        from transformers import AutoModel

        self.model = built(AutoModel, folder, config, pretrained)
        vision = config.vision_config
        self.num_cameras = num_cameras
        self.image_size = vision.image_size
        self.image_token = int(config.image_token_id)
        self.tokens_per_image = (vision.image_size // vision.patch_size) ** 2
        self.out_dim: int = config.text_config.hidden_size

    def forward(
        self, images: Tensor, img_masks: Tensor, tokens: Tensor, masks: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Hidden states ``(B, L, out_dim)`` and their masks ``(B, L)``, images first.

        Args:
            images: ``(B, 3N, H, W)`` in -1..1; img_masks: ``(B, N)``; tokens, masks: ``(B, L)``.
        """
        count = self.num_cameras * self.tokens_per_image
        image_tokens = tokens.new_full((len(tokens), count), self.image_token)
        mask = torch.cat([img_masks.repeat_interleave(self.tokens_per_image, 1), masks], dim=1)
        ids = torch.cat([image_tokens, tokens], dim=1)
        output = self.model(
            input_ids=ids,
            pixel_values=split_views(images, self.num_cameras, self.image_size),
            attention_mask=mask.long(),
            position_ids=mask.long().cumsum(1).clamp(min=1),  # it counts from 1
            token_type_ids=torch.zeros_like(ids),
            use_cache=False,
        )
        return output.last_hidden_state, mask

    def fsdp_units(self) -> list[nn.Module]:
        """Blocks to shard one by one."""
        return layers_of(self.model)


def described(
    model_folder: str,
    kinds: Sequence[str],
    pretrained: bool,
    sizes: Sizes | None,
    part: str | None = None,
) -> tuple[Path | None, Any]:
    """The folder and the transformers configuration in it; None and that of ``sizes``, where the
    folder is absent and its weights are not needed.

    Args:
        part: the configuration inside that one that is meant, where there is such a one.

    Raises:
        ConfigError: as of ``SigLIPBackbone``.
    """
    try:
        folder = checked_folder(model_folder)
    except ConfigError as error:
        absent = not Path(model_folder).expanduser().exists()
        if sizes is not None and absent and (weights_follow() or not pretrained):
            return None, config_of(sizes, kinds[:1])
        if absent and error.next is not None:
            error.next += "; for a dry run without it: sizes=dict(...), values of its config.json"
        raise
    config = read_config(folder, kinds)
    config = config if part is None else getattr(config, part, config)
    if sizes is not None:
        config_of(sizes, kinds[:1])
        _compare(sizes, config, str(folder / "config.json"))
    return folder, config


def config_of(sizes: Sizes, kinds: Sequence[str]) -> Any:
    """The transformers configuration that has ``sizes``.

    Raises:
        ConfigError: ``sizes`` lack a ``model_type`` of ``kinds``, or have a setting that such a
            model does not have.
    """
    from transformers import AutoConfig

    kind = sizes.get("model_type")
    if kind not in kinds:
        raise ConfigError(
            f"sizes.model_type is {kind!r}; {' or '.join(kinds)} is expected",
            next="take it from the model's config.json",
        )
    _check_names(sizes, AutoConfig.for_model(kind), "sizes")
    try:
        return AutoConfig.for_model(**_plain(sizes))
    except Exception as error:  # whatever wrong values make transformers raise
        raise ConfigError(
            f"no {kind} can be built of its sizes: {type(error).__name__}: {error}"
        ) from error


def sizes_of(config: Any) -> dict[str, Any]:
    """The ``sizes`` that make an equal model: values that are not transformers' defaults."""
    found = {k: v for k, v in config.to_diff_dict().items() if k not in _NO_SIZES and k[0] != "_"}
    for name, part in found.items():
        if isinstance(part, dict) and name.endswith("_config"):
            found[name] = sizes_of(getattr(config, name))
    return {**found, "model_type": config.model_type}


def _check_names(sizes: Sizes, config: Any, at: str) -> None:
    known = {*config.to_dict(), "head_dim"}  # not a field of all, and read by all
    for name, value in sizes.items():
        if name in _REFUSED or name.startswith("_") or name not in known:
            raise ConfigError(
                f"{at}.{name}: a {config.model_type} has no such setting",
                next="take the names from the model's config.json",
            )
        if isinstance(value, Mapping) and name.endswith("_config"):
            _check_names(value, getattr(config, name), f"{at}.{name}")


def _compare(sizes: Sizes, config: Any, where: str, at: str = "sizes") -> None:
    """Compare ``sizes`` with the ``config`` that was read from ``where``."""
    for name, value in sizes.items():
        there = getattr(config, name, None)
        if isinstance(value, Mapping) and hasattr(there, "to_dict"):
            _compare(value, there, where, f"{at}.{name}")
        elif name != "model_type" and _plain(value) != _plain(there):
            raise ConfigError(
                f"{at}.{name} is {value!r}, config.json has {there!r}",
                where=where,
                cause="the folder is of another model, or sizes are",
            )


def _plain(value: Any) -> Any:
    """Tables and lists of a config, which may be frozen, as dicts and lists."""
    if isinstance(value, Mapping):
        return {name: _plain(inner) for name, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, list | tuple) else value


def read_config(folder: Path, kinds: Sequence[str]) -> Any:
    """The transformers configuration in ``folder``.

    Raises:
        ConfigError: there is none, or its ``model_type`` is not one of ``kinds``.
    """
    from transformers import AutoConfig

    try:
        config = AutoConfig.from_pretrained(
            str(folder), local_files_only=True, trust_remote_code=False
        )
    except Exception as error:  # whatever damaged files make transformers raise
        raise ConfigError(
            f"no model can be built from it: {type(error).__name__}: {error}", where=str(folder)
        ) from error
    if config.model_type not in kinds:
        raise ConfigError(
            f"the model is a {config.model_type}; {' or '.join(kinds)} is expected",
            where=str(folder / "config.json"),
        )
    return config


def built(kind: Any, folder: Path | None, config: Any, pretrained: bool) -> nn.Module:
    """A transformers model in float32, with the folder's weights or, if not ``pretrained`` or if
    others follow, new ones.

    Raises:
        ConfigError: the folder has no weights, or not all of them.
    """
    if folder is None or not pretrained or weights_follow():
        if hasattr(kind, "from_config"):
            return kind.from_config(config, trust_remote_code=False)
        return kind(config)
    from transformers.utils import logging

    logging.disable_progress_bar()
    verbosity = logging.get_verbosity()
    logging.set_verbosity_error()  # heads that are left out are no news
    try:
        model, info = kind.from_pretrained(
            str(folder),
            config=config,
            dtype=torch.float32,
            local_files_only=True,
            use_safetensors=True,
            trust_remote_code=False,
            output_loading_info=True,
            ignore_mismatched_sizes=True,  # they are reported below
        )
    except Exception as error:  # whatever damaged files make transformers raise
        raise ConfigError(
            f"its weights cannot be read: {type(error).__name__}: {error}",
            where=str(folder),
            cause="the folder was copied or downloaded in part",
            next="copy or download it again; pretrained=False, where a checkpoint has the weights",
        ) from error
    finally:
        logging.set_verbosity(verbosity)
    wrong = _listed(info, ("missing_keys", "mismatched_keys"))
    if wrong:
        raise ConfigError(
            f"its weights are not all there: {', '.join(wrong[:4])}{' …' if wrong[4:] else ''}",
            where=str(folder),
            cause="config.json is of another model, or the folder was copied in part",
            next="copy or download it again; pretrained=False, where a checkpoint has the weights",
        )
    return model


def split_views(images: Tensor, cameras: int, size: int) -> Tensor:
    """``(B, 3N, H, W)`` -> ``(B * N, 3, H, W)``.

    Raises:
        ConfigError: N is not ``cameras``, or H and W not ``size``.
    """
    if images.shape[1] != 3 * cameras:
        raise ConfigError(
            f"num_cameras is {cameras}, the batch has {images.shape[1]} image channels "
            f"({images.shape[1] // 3} cameras)",
            next="num_cameras is the number of img_keys",
        )
    if tuple(images.shape[2:]) != (size, size):
        raise ConfigError(
            f"images are {images.shape[2]} x {images.shape[3]}, the encoder sees {size} x {size}",
            next=f"dict(type='ResizeImages', height={size}, width={size})",
        )
    return images.reshape(len(images) * cameras, 3, size, size)


def layers_of(model: nn.Module) -> list[nn.Module]:
    """The layers of every transformer in ``model``."""
    return [
        layer
        for name, module in model.named_modules()
        if isinstance(module, nn.ModuleList) and name.rpartition(".")[2] == "layers"
        for layer in module
    ]


def _listed(info: Mapping[str, Any], kinds: Sequence[str]) -> list[str]:
    """What ``from_pretrained`` says: names, or for sizes that differ ``(name, there, here)``."""
    found = (entry for kind in kinds for entry in info.get(kind, ()))
    return sorted(
        entry
        if isinstance(entry, str)
        else f"{entry[0]} {tuple(entry[1])}, by config.json {tuple(entry[2])}"
        for entry in found
    )
