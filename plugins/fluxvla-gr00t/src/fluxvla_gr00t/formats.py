"""The checkpoints that NVIDIA publishes, and its Isaac-GR00T saves, of GR00T N1.5 and N1.7."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from fluxvla_core.errors import CheckpointError, FluxError
from fluxvla_core.models import (
    CheckpointFormat,
    ForeignCheckpoint,
    check_settings,
    safetensors_in,
)
from fluxvla_core.results import read_json
from fluxvla_gr00t.robots import fewer_cameras, n15_robot, n17_robot
from fluxvla_gr00t.tables import (
    checkpoint,
    model_table,
    n15_transforms,
    n17_transforms,
    resize_table,
)

_FIXED = {
    "add_pos_embed": True,
    "use_vlln": True,
    "num_timestep_buckets": 1000,
    "state_history_length": 1,
    "expand_batch": None,
    "exclude_state": False,
    "apply_sincos_state_encoding": False,
}
"""Settings that change what the model computes, and the values that are known here."""
_FIXED_DIT = {
    "norm_type": "ada_norm",
    "positional_embeddings": None,
    "interleave_self_attention": True,
    "activation_fn": "gelu-approximate",
    "attention_bias": True,
    "norm_eps": 1e-5,
}
_DIT = (
    *_FIXED_DIT,
    "num_layers",
    "num_attention_heads",
    "attention_head_dim",
    "output_dim",
    "cross_attention_dim",
    "dropout",
    "final_dropout",
    "num_embeds_ada_norm",
    "max_num_positional_embeddings",
    "compute_dtype",
)
_TRAINING = ("tune_", "noise_", "load_", "use_flash_attention", "model_dtype", "compute_dtype")
"""How names of settings begin that say how it is trained, or in which dtype."""
_HEAD = (
    *_FIXED,
    "diffusion_model_cfg",
    "vl_self_attention_cfg",
    "hidden_size",
    "input_embedding_dim",
    "backbone_embedding_dim",
    "action_horizon",
    "action_dim",
    "max_action_dim",
    "max_state_dim",
    "max_num_embodiments",
    "max_seq_len",
    "num_inference_timesteps",
    "num_target_vision_tokens",
    "detection_coeff",
)
_SAVED = (
    "model_type",
    "architectures",
    "auto_map",
    "attn_implementation",
    "dtype",
    "torch_dtype",
    "transformers_version",
)
"""What transformers writes into any model's config."""
_N15 = (*_SAVED, "action_dim", "action_head_cfg", "action_horizon", "backbone_cfg", "hidden_size")
_N15_BACKBONE = ("eagle_path", "project_to_dim", "select_layer")
_N17 = (
    *_SAVED,
    *_HEAD,
    "model_name",
    "model_revision",
    "backbone_model_type",
    "backbone_trainable_params_fp32",
    "select_layer",
    "image_crop_size",
    "image_target_size",
    "shortest_image_edge",
    "crop_fraction",
    "letter_box_transform",
    "random_rotation_angle",
    "color_jitter_params",
    "extra_augmentation_config",
    "use_albumentations",
    "use_albumentations_transforms",
    "formalize_language",
    "use_percentiles",
    "use_relative_action",
    "use_mean_std",
    "clip_outliers",
    "attn_dropout",
    "use_alternate_vl_dit",
    "attend_text_every_n_blocks",
    "state_dropout_prob",
    "rtc_config",
)


class GR00TN15Format(CheckpointFormat):
    """Folders of GR00T N1.5: ``config.json``, ``model*.safetensors``, ``experiment_cfg``."""

    name: ClassVar[str] = "gr00t"
    model_types: ClassVar[tuple[str, ...]] = ("GR00T",)

    def recognizes(self, folder: Path) -> bool:
        """Whether its ``config.json`` is of GR00T N1.5."""
        return _model_type(folder) == "gr00t_n1_5"

    def read(
        self,
        folder: Path,
        tokenizer: str | None = None,
        robot: str | None = None,
        absent: Sequence[str] = (),
    ) -> ForeignCheckpoint:
        """The checkpoint in ``folder``.

        Args:
            tokenizer: the folder of Eagle's tokenizer.
            robot: its embodiment tag.
            absent: cameras without images; NVIDIA's takes as many as there are.

        Raises:
            CheckpointError: it is damaged, or does something that GR00T here does not.
            UsageError: it knows no such robot or camera.
        """
        file = folder / "config.json"
        config = read_json(file, dict[str, Any], CheckpointError)
        chosen = fewer_cameras(n15_robot(folder, robot), absent, str(folder))
        settings = _Settings(config.get("action_head_cfg"), str(file))
        backbone = _Settings(config.get("backbone_cfg"), str(file))
        _Settings(config, str(file)).check(_N15)
        settings.check(_HEAD)
        backbone.check(_N15_BACKBONE)
        if backbone.get("project_to_dim") is not None:
            raise CheckpointError(
                f"backbone_cfg.project_to_dim is {backbone.get('project_to_dim')}, None is known",
                where=str(file),
            )
        head = {
            **_head(settings),
            "action_dim": settings.count("action_dim"),
            "future_tokens": settings.count("num_target_vision_tokens"),
        }
        model = model_table("n1.5", head, chosen, backbone.count("select_layer"))
        transforms = n15_transforms(model, chosen, tokenizer)
        return checkpoint("n1.5", safetensors_in(folder), model, transforms, chosen, str(folder))


class GR00TN17Format(CheckpointFormat):
    """Folders of GR00T N1.7: ``config.json``, ``model*.safetensors``, ``processor_config.json``,
    ``statistics.json`` and ``embodiment_id.json``."""

    name: ClassVar[str] = "gr00t"
    model_types: ClassVar[tuple[str, ...]] = ("GR00T",)

    def recognizes(self, folder: Path) -> bool:
        """Whether its ``config.json`` is of GR00T N1.7."""
        return _model_type(folder) == "Gr00tN1d7"

    def read(
        self,
        folder: Path,
        tokenizer: str | None = None,
        robot: str | None = None,
        absent: Sequence[str] = (),
    ) -> ForeignCheckpoint:
        """The checkpoint in ``folder``.

        Args:
            tokenizer: the folder of Qwen3-VL's tokenizer.
            robot: its embodiment tag.
            absent: cameras without images; NVIDIA's takes as many as there are.

        Raises:
            CheckpointError: it is damaged, or does something that GR00T here does not.
            UsageError: it knows no such robot or camera.
        """
        file = folder / "config.json"
        settings = _Settings(read_json(file, dict[str, Any], CheckpointError), str(file))
        settings.check(_N17)
        processing = folder / "processor_config.json"
        kwargs: Mapping[str, Any] = {"modality_configs": {}}
        if processing.is_file():
            content = read_json(processing, dict[str, Any], CheckpointError)
            kwargs = _Settings(content.get("processor_kwargs"), str(processing)).values
        chosen = fewer_cameras(n17_robot(folder, kwargs, robot), absent, str(folder))
        alternate = settings.get("use_alternate_vl_dit", True)
        head = {
            **_head(settings),
            "action_dim": settings.count("max_action_dim"),
            "future_tokens": 0,
            "attend_text_every": settings.count("attend_text_every_n_blocks")
            if alternate
            else None,
            "state_dropout": float(settings.get("state_dropout_prob", 0.0)),
        }
        model = model_table("n1.7", head, chosen, settings.count("select_layer"))
        both = {**settings.values, **kwargs}
        transforms = n17_transforms(
            model,
            chosen,
            tokenizer,
            resize_table(both, str(processing)),
            bool(kwargs.get("formalize_language", True)),
            bool(kwargs.get("clip_outliers", True)),
        )
        return checkpoint("n1.7", safetensors_in(folder), model, transforms, chosen, str(folder))


class _Settings:
    """Settings of a ``config.json``, read one by one."""

    def __init__(self, values: Any, where: str) -> None:
        if not isinstance(values, dict):
            raise CheckpointError("the settings of the model are no table", where=where)
        self.values: dict[str, Any] = values
        self.where = where

    def get(self, name: str, default: Any = None) -> Any:
        return self.values.get(name, default)

    def count(self, name: str) -> int:
        value = self.values.get(name)
        if not isinstance(value, int) or isinstance(value, bool):
            raise CheckpointError(
                f"{name} is {value!r}, a whole number is expected", where=self.where
            )
        return value

    def table(self, name: str) -> _Settings:
        return _Settings(self.values.get(name), self.where)

    def check(self, known: Collection[str]) -> None:
        """Refuse settings that are neither ``known`` nor of training alone."""
        rest = {n: value for n, value in self.values.items() if not n.startswith(_TRAINING)}
        check_settings(rest, known, self.where)

    def require(self, values: Mapping[str, Any]) -> None:
        for name, value in values.items():
            found = self.values.get(name, value)
            if found != value:
                raise CheckpointError(
                    f"{name} is {found!r}, {value!r} is known here",
                    where=self.where,
                    cause="the model computes something else than GR00T as it is built here",
                )


def _head(settings: _Settings) -> dict[str, Any]:
    """Settings of the head that both versions name alike."""
    dit, context = settings.table("diffusion_model_cfg"), settings.table("vl_self_attention_cfg")
    settings.require(_FIXED)
    dit.check(_DIT)
    context.check(_DIT)
    dit.require({**_FIXED_DIT, "output_dim": settings.count("hidden_size")})
    context.require({"positional_embeddings": None, "dropout": dit.get("dropout")})
    return {
        "type": "GR00TActionHead",
        "horizon": settings.count("action_horizon"),
        "state_dim": settings.count("max_state_dim"),
        "embodiments": settings.count("max_num_embodiments"),
        "layers": dit.count("num_layers"),
        "heads": dit.count("num_attention_heads"),
        "head_dim": dit.count("attention_head_dim"),
        "hidden_dim": settings.count("hidden_size"),
        "context_layers": context.count("num_layers"),
        "context_heads": context.count("num_attention_heads"),
        "max_steps": settings.count("max_seq_len"),
        "num_steps": settings.count("num_inference_timesteps"),
        "dropout": float(dit.get("dropout", 0.0)),
    }


def _model_type(folder: Path) -> str | None:
    """``model_type`` of ``config.json``; None if there is none, or it is LeRobot's config."""
    try:
        config = read_json(folder / "config.json", dict[str, Any], CheckpointError)
    except FluxError:
        return None
    kind = config.get("model_type")
    return kind if isinstance(kind, str) and "type" not in config else None
