"""GR00T as LeRobot saves it: ``config.json``, ``model.safetensors`` and two processors.

N1.5 was saved by LeRobot up to 0.5, N1.7 is by LeRobot 0.6. The sizes of the model are not in the
files; they are those that NVIDIA publishes. The step that packs inputs has what is known of the
robot in ``policy_preprocessor.json``, and statistics as ``feature.statistic`` in a file of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from fluxvla_models.lerobot_files import (
    POSTPROCESSOR,
    PREPROCESSOR,
    Step,
    check_policy_settings,
    full_tensor,
    policy_type,
    read_steps,
)

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import CheckpointFormat, ForeignCheckpoint, safetensors_in
from fluxvla_core.results import read_json
from fluxvla_gr00t.robots import GRIPPER, Robot, fewer_cameras, flat_robot, grouped_robot
from fluxvla_gr00t.tables import (
    checkpoint,
    model_table,
    n15_transforms,
    n17_transforms,
    resize_table,
)

PACKS = {"groot_pack_inputs_v3": "n1.5", "groot_n1_7_pack_inputs_v1": "n1.7"}
"""The step that packs inputs -> the version."""
_BEFORE = {
    "rename_observations_processor",
    "to_batch_processor",
    "relative_actions_processor",
    *PACKS,
    "groot_eagle_encode_v3",
    "groot_eagle_collate_v3",
    "groot_n1_7_vlm_encode_v1",
    "device_processor",
}
_AFTER = {
    "groot_action_unpack_unnormalize_v1",
    "groot_action_unpack_unnormalize_v2",
    "groot_n1_7_action_decode_v1",
    "absolute_actions_processor",
    "device_processor",
}
HEADS: dict[str, dict[str, Any]] = {
    "n1.5": {"type": "GR00TActionHead", "horizon": 16},
    "n1.7": {
        "type": "GR00TActionHead",
        "horizon": 40,
        "layers": 32,
        "future_tokens": 0,
        "attend_text_every": 2,
        "state_dropout": 0.2,
    },
}
_SETTINGS = (
    "max_state_dim",
    "max_action_dim",
    "image_size",
    "base_model_path",
    "tokenizer_assets_repo",
    "embodiment_tag",
    "model_version",
    "action_decode_transform",
    "num_inference_timesteps",
    "rtc_ramp_rate",
    "rtc_config",
    "use_relative_actions",
    "relative_exclude_joints",
    "action_feature_names",
    "color_jitter_params",
    "tune_llm",
    "tune_visual",
    "tune_projector",
    "tune_diffusion_model",
    "tune_vlln",
    "tune_top_llm_layers",
    "lora_rank",
    "lora_alpha",
    "lora_dropout",
    "lora_full_model",
    "warmup_ratio",
    "use_bf16",
    "use_flash_attention",
    "model_params_fp32",
    "video_backend",
    "balance_dataset_weights",
    "balance_trajectory_weights",
    "dataset_paths",
    "output_dir",
    "save_steps",
    "max_steps",
    "batch_size",
    "dataloader_num_workers",
    "report_to",
    "resume",
)
"""Its own names of settings in LeRobot's config of GR00T."""
_PREFIX = "_groot_model."
_IMAGES = "observation.images."
_PRE = f"{PREPROCESSOR}.json"


class LeRobotGR00TFormat(CheckpointFormat):
    """Folders of LeRobot's ``save_pretrained``."""

    name: ClassVar[str] = "lerobot"
    model_types: ClassVar[tuple[str, ...]] = ("GR00T",)

    def recognizes(self, folder: Path) -> bool:
        """Whether its ``config.json`` says ``"type": "groot"``."""
        return policy_type(folder) == "groot"

    def read(
        self, folder: Path, tokenizer: str | None = None, absent: Sequence[str] = ()
    ) -> ForeignCheckpoint:
        """The checkpoint in ``folder``.

        Args:
            tokenizer: the folder of the backbone's tokenizer.
            absent: cameras without images; LeRobot takes as many as there are.

        Raises:
            CheckpointError: it is damaged, or has steps that are not LeRobot's for GR00T.
            UsageError: it has no such camera.
        """
        config = read_json(folder / "config.json", dict[str, Any], CheckpointError)
        check_policy_settings(config, _SETTINGS, str(folder / "config.json"))
        steps, packing, version = _preprocessor(folder)
        pack = packing.config
        chosen = fewer_cameras(_robot(folder, steps, packing, config), absent, str(folder))
        head = {
            **HEADS[version],
            "action_dim": _count(pack, "max_action_dim", folder / _PRE),
            "state_dim": _count(pack, "max_state_dim", folder / _PRE),
        }
        if config.get("num_inference_timesteps") is not None:
            head["num_steps"] = _count(config, "num_inference_timesteps", folder / "config.json")
        model = model_table(version, head, chosen)
        if version == "n1.5":
            if pack.get("formalize_language"):
                raise CheckpointError(
                    "formalize_language is True; False is known here for N1.5",
                    where=str(folder / _PRE),
                )
            transforms = n15_transforms(model, chosen, tokenizer)
        else:
            encoding = steps.get("groot_n1_7_vlm_encode_v1")
            encode = {} if encoding is None else encoding.config
            transforms = n17_transforms(
                model,
                chosen,
                tokenizer,
                resize_table(encode, str(folder / _PRE)),
                bool(pack.get("formalize_language", True)),
                bool(pack.get("clip_outliers", True)),
            )
        stored = {n.removeprefix(_PREFIX): t for n, t in safetensors_in(folder).items()}
        return checkpoint(version, stored, model, transforms, chosen, str(folder))

    def write(self, checkpoint: ForeignCheckpoint, folder: Path) -> None:
        """Write it as LeRobot saves it: N1.7 as by its version 0.6, N1.5 as by 0.4.

        Raises:
            CheckpointError: its sizes are not the published ones, or LeRobot's processors cannot
                do what its transforms do.
        """
        # Here: it imports transformers, and every import of any checkpoint loads this module.
        from fluxvla_gr00t.lerobot_write import write

        write(checkpoint, folder, HEADS)


def _preprocessor(folder: Path) -> tuple[dict[str, Step], Step, str]:
    """All steps by their names, the one that packs inputs, and the version that it is of."""
    steps = {step.name: step for step in read_steps(folder, PREPROCESSOR, _BEFORE)}
    found = [name for name in PACKS if name in steps]
    if len(found) != 1:
        raise CheckpointError(
            f"the processor has the steps {', '.join(steps)}; one of {', '.join(PACKS)} is "
            "expected",
            where=str(folder / _PRE),
            cause="it was saved by another version of LeRobot",
        )
    return steps, steps[found[0]], PACKS[found[0]]


def _robot(
    folder: Path, steps: Mapping[str, Step], packing: Step, config: Mapping[str, Any]
) -> Robot:
    """The robot, without statistics where something is done to its actions that is not here."""
    where = str(folder / _PRE)
    pack = packing.config
    tag, numbers = pack.get("embodiment_tag"), pack.get("embodiment_mapping")
    # LeRobot takes 0 for a tag that is not listed.
    number = numbers.get(tag, 0) if isinstance(numbers, dict) else None
    if not isinstance(tag, str) or not isinstance(number, int):
        raise CheckpointError("embodiment_mapping: no number for embodiment_tag", where=where)
    if not pack.get("normalize_min_max", True):
        raise CheckpointError(
            "normalize_min_max is False; states and actions that are not normalised are not known "
            "here",
            where=where,
        )
    for name in ("state_horizon", "video_horizon"):
        if pack.get(name) not in (None, 1):
            raise CheckpointError(f"{name} is {pack[name]!r}, 1 is known here", where=where)
    post = {step.name: step.config for step in read_steps(folder, POSTPROCESSOR, _AFTER)}
    grouped = "groot_n1_7_action_decode_v1"
    if grouped in post and pack.get("raw_stats") and pack.get("modality_config"):
        before, after = (bool(c.get("use_percentiles")) for c in (pack, post[grouped]))
        if before != after:
            raise CheckpointError(
                f"use_percentiles of the preprocessor is {before}, of the postprocessor {after}",
                where=where,
            )
        settings = {
            "use_percentiles": pack.get("use_percentiles"),
            "use_relative_action": post[grouped].get("use_relative_action"),
        }
        tables = pack["modality_config"], pack["raw_stats"]
        robot = grouped_robot(tag, number, *tables, settings, where)
    else:
        found = {name: full_tensor(stored).tolist() for name, stored in packing.tensors.items()}
        robot = flat_robot(tag, number, found, where)
    trained = pack.get("valid_action_horizon")
    horizon = trained if isinstance(trained, int) else robot.horizon
    seen = _policy_names(steps, where)
    cameras = tuple(seen.get(name, name) for name in _cameras(config, pack))
    robot = replace(robot, img_keys=cameras, horizon=horizon)
    changed = ("libero_gripper_action", "action_decode_transform")
    if any(step.get(name) for step in post.values() for name in changed):
        return replace(robot, statistics={}, notes=(GRIPPER,))
    before = {name: step.config for name, step in steps.items()}
    relative = ("relative_actions_processor", before), ("absolute_actions_processor", post)
    if any(name in found and found[name].get("enabled", True) for name, found in relative):
        return replace(robot, statistics={}, notes=(*robot.notes, _RELATIVE))
    return robot


_RELATIVE = (
    "LeRobot counts its actions from the state by a step of its own, which is not done here: it "
    "can be trained on, and drives no robot"
)


def _policy_names(steps: Mapping[str, Step], where: str) -> dict[str, str]:
    """The policy's name of a camera -> the robot's, where LeRobot renames it."""
    step = steps.get("rename_observations_processor")
    renamed = {} if step is None else step.config.get("rename_map") or {}
    if not isinstance(renamed, dict) or not all(isinstance(n, str) for n in renamed.values()):
        raise CheckpointError(f"rename_map is {renamed!r}, no table of names", where=where)
    return {
        policy.removeprefix(_IMAGES): robot.removeprefix(_IMAGES)
        for robot, policy in renamed.items()
    }


def _cameras(config: Mapping[str, Any], pack: Mapping[str, Any]) -> tuple[str, ...]:
    """Cameras in the order of the model: as listed, otherwise by their names."""
    features = config.get("input_features") or {}
    names = sorted(n.removeprefix(_IMAGES) for n in features if n.startswith(_IMAGES))
    wanted = pack.get("video_modality_keys") or []
    # LeRobot's conversions of LIBERO call the wrist's camera so.
    alias = {"wrist_image": "image2"}
    ordered = [n if n in names else alias.get(n) for n in wanted]
    listed = tuple(name for name in ordered if name in names)
    return listed or tuple(names)


def _count(config: Mapping[str, Any], name: str, file: Path) -> int:
    value = config.get(name)
    if not isinstance(value, int) or isinstance(value, bool):
        raise CheckpointError(f"{name} is {value!r}, a whole number is expected", where=str(file))
    return value
