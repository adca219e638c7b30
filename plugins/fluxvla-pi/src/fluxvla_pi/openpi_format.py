"""PI0 and PI0.5 as openpi saves them in PyTorch: weights and ``assets/<id>/norm_stats.json``.

``config.json`` is there if the weights were converted from JAX, and has the length of a chunk.
Which robot it is, and what openpi's data config did to states and actions before (actions relative
to the state, joints turned round), is in no file.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from safetensors.torch import save_file

from fluxvla_core.errors import CheckpointError
from fluxvla_core.models import (
    CheckpointFormat,
    ForeignCheckpoint,
    check_settings,
    chosen_robot,
    without_cameras,
)
from fluxvla_core.results import read_json
from fluxvla_pi.names import OPENPI
from fluxvla_pi.published import (
    FAMILIES,
    family_of,
    only,
    table_of,
    weights_in,
    weights_to_write,
)

CAMERAS = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")
STATISTICS = "norm_stats.json"
TOKENIZER = "google/paligemma-3b-pt-224"
ENTRIES = {"state": "proprio", "actions": "action"}
"""Their entries -> ours."""
NORM_TYPES = {"pi0": "mean_std", "pi05": "quantile"}
MAX_LENGTHS = {"pi0": 48, "pi05": 200}
HORIZON = 50
EPSILON = 1e-6
_SETTINGS = (
    "action_dim",
    "action_horizon",
    "paligemma_variant",
    "action_expert_variant",
    "precision",
)
"""What openpi's conversion writes into ``config.json``."""


class OpenPiFormat(CheckpointFormat):
    """openpi's PyTorch checkpoints."""

    name: ClassVar[str] = "openpi"
    model_types: ClassVar[Sequence[str]] = tuple(kind.__name__ for kind in FAMILIES.values())

    def recognizes(self, folder: Path) -> bool:
        """Whether there are weights, and statistics as openpi has them."""
        return (folder / "model.safetensors").is_file() and bool(_statistics_files(folder))

    def read(
        self,
        folder: Path,
        tokenizer: str | None = None,
        robot: str | None = None,
        absent: Sequence[str] = (),
    ) -> ForeignCheckpoint:
        """The checkpoint in ``folder``.

        Args:
            tokenizer: the folder of PaliGemma's tokenizer.
            robot: the folder below ``assets`` that has its statistics.
            absent: cameras without images, which openpi masks.

        Raises:
            CheckpointError: it is damaged, or of a model that is not built here.
            UsageError: it knows no such robot or camera.
        """
        assets = folder / "assets"
        files = {f.parent.relative_to(assets).as_posix(): f for f in _statistics_files(folder)}
        chosen = chosen_robot(files, robot, str(assets))
        cameras = without_cameras(CAMERAS, absent, str(folder))
        weights = weights_in(folder)
        statistics, cut = {}, False
        if chosen is not None:
            statistics, cut = _statistics(files[chosen], weights.family)
        horizon, known = _horizon(folder)
        model = {**weights.model, "n_action_steps": horizon}
        notes = [
            "openpi's data config is in no file: if it made actions relative to the state, or "
            "turned joints round (adapt_to_pi), so must the robot's operator here; the prompt of "
            "PI0.5 is made with the state (discrete_state_input)",
            f"cameras are openpi's: --camera {CAMERAS[0]}=NAME",
        ]
        if chosen is None:
            notes.append(
                f"there are statistics of several robots ({', '.join(files)}): choose one by "
                "--robot NAME; as it is, it can be trained on, and drives none"
            )
        if not known:
            notes.append(f"config.json has no action_horizon: chunks of {HORIZON} are assumed")
        if cut:
            notes.append("dimensions that openpi had only filled up with zeros were left out")
        if tokenizer is None:
            notes.append(f"its tokenizer is {TOKENIZER}; --tokenizer names the folder that has it")
        return ForeignCheckpoint(
            model=model,
            tensors=weights.tensors,
            img_keys=cameras,
            transforms=()
            if chosen is None
            else _transforms(weights.family, model, tokenizer or TOKENIZER),
            statistics={"private": statistics},
            horizon=horizon,
            notes=notes,
        )

    def write(self, checkpoint: ForeignCheckpoint, folder: Path) -> None:
        """Write ``checkpoint`` into ``folder``; see ``CheckpointFormat``."""
        family = family_of(checkpoint)
        numbers = table_of(checkpoint, "NormalizeStatesAndActions")
        only(numbers, "norm_type", NORM_TYPES[family], "mean_std")
        only(numbers, "state_norm_type", numbers.get("norm_type", "mean_std"), NORM_TYPES[family])
        only(numbers, "epsilon", EPSILON, EPSILON)
        only(numbers, "epsilon_if_zero", False, False)
        only(numbers, "std_floor", 0.0, 0.0)
        only(numbers, "action_norm_mask", None, None)
        only(table_of(checkpoint, "ResizeImagesWithPad"), "interpolation", "antialias", "antialias")
        if family == "pi0":
            only(table_of(checkpoint, "PreparePrompt"), "clean", True, True)
        else:
            only(table_of(checkpoint, "PreparePromptWithState"), "state_dim", None, None)
        entries = checkpoint.statistics["private"]
        if entries["action"].get("relative") is not None:
            raise CheckpointError(
                "actions are relative to the state, which openpi's files cannot say"
            )
        stats = {
            theirs: {name: entries[ours].get(name) for name in ("mean", "std", "q01", "q99")}
            for theirs, ours in ENTRIES.items()
        }
        robot = "robot" if checkpoint.embodiment is None else checkpoint.embodiment.name
        assets = folder / "assets" / Path(robot).name
        assets.mkdir(parents=True)
        (assets / STATISTICS).write_text(json.dumps({"norm_stats": stats}, indent=2), "utf-8")
        config = {
            "action_dim": checkpoint.model.get("max_action_dim", 32),
            "action_horizon": checkpoint.horizon,
            "paligemma_variant": checkpoint.model.get("variant", "gemma_2b"),
            "action_expert_variant": checkpoint.model.get("expert_variant", "gemma_300m"),
        }
        (folder / "config.json").write_text(json.dumps(config, indent=2), encoding="utf-8")
        tensors = weights_to_write(checkpoint, OPENPI)
        twin = OPENPI.theirs("llm_backbone.embed_tokens.weight")
        save_file(tensors, folder / "model.safetensors", {"format": "pt", twin: OPENPI.head})


def _statistics_files(folder: Path) -> list[Path]:
    """The files of statistics; an asset's id may be a path of several parts."""
    return sorted((folder / "assets").glob(f"**/{STATISTICS}"))


def _statistics(file: Path, family: str) -> tuple[dict[str, Any], bool]:
    """Our entries, and whether dimensions without any data were left out."""
    where = str(file)
    content = read_json(file, dict[str, Any], CheckpointError)
    found: dict[str, Any] = {}
    cut = False
    wanted = ("mean", "std") if family == "pi0" else ("mean", "std", "q01", "q99")
    for theirs, ours in ENTRIES.items():
        tables = content.get("norm_stats")
        table = tables.get(theirs) if isinstance(tables, Mapping) else None
        table = table if isinstance(table, Mapping) else {}
        lacks = [name for name in wanted if table.get(name) is None]
        if lacks:
            raise CheckpointError(
                f"norm_stats: {theirs!r} has no {', '.join(lacks)}; it has "
                f"{', '.join(sorted(table)) or 'nothing'}",
                where=where,
                next="compute the statistics again with openpi's scripts/compute_norm_stats.py",
            )
        given = {n: table[n] for n in ("mean", "std", "q01", "q99") if table.get(n) is not None}
        try:
            rows = {name: np.asarray(row, np.float64) for name, row in given.items()}
        except (TypeError, ValueError) as error:
            raise CheckpointError(
                f"norm_stats: {theirs!r}: {', '.join(given)} are not rows of numbers", where=where
            ) from error
        if any(row.ndim != 1 or row.shape != rows["mean"].shape for row in rows.values()):
            raise CheckpointError(
                f"norm_stats: {theirs!r}: mean, std and quantiles are no rows of one length",
                where=where,
            )
        used = np.flatnonzero(np.any([row != 0 for row in rows.values()], axis=0))
        width = int(used[-1]) + 1 if len(used) else 0
        if not width:
            raise CheckpointError(f"norm_stats: {theirs!r} is 0 throughout", where=where)
        cut = cut or width < len(rows["mean"])
        found[ours] = {name: row[:width].tolist() for name, row in rows.items()}
    return found, cut


def _horizon(folder: Path) -> tuple[int, bool]:
    """Actions in a chunk, and whether a file says so."""
    file = folder / "config.json"
    if not os.path.lexists(file):
        return HORIZON, False
    config = read_json(file, dict[str, Any], CheckpointError)
    check_settings(config, _SETTINGS, str(file))
    horizon = config.get("action_horizon")
    if horizon is None:
        return HORIZON, False
    if not isinstance(horizon, int) or horizon < 1:
        raise CheckpointError(f"action_horizon is {horizon!r}", where=str(file))
    return horizon, True


def _transforms(family: str, model: Mapping[str, Any], tokenizer: str) -> list[dict[str, Any]]:
    vision = model["vision_variant"]
    side = 224 if isinstance(vision, str) else vision["image_size"]
    numbers: dict[str, Any] = {
        "type": "NormalizeStatesAndActions",
        "norm_type": NORM_TYPES[family],
        "action_dim": model["max_action_dim"],
        "epsilon": EPSILON,
    }
    if family == "pi0":
        numbers["state_dim"] = model["max_state_dim"]
    prompt = "PreparePrompt" if family == "pi0" else "PreparePromptWithState"
    return [
        {"type": "ResizeImagesWithPad", "height": side, "width": side},
        {"type": "SimpleNormalizeImages"},
        numbers,
        {"type": prompt},
        {
            "type": "ProcessPrompts",
            "tokenizer": {"type": "PretrainedTokenizer", "model_path": tokenizer},
            "max_len": MAX_LENGTHS[family],
        },
    ]
