"""One camera and four, 13 joints, images of odd sides, loader workers, a narrow terminal."""

from __future__ import annotations

import json
import re
import sys
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("fluxvla_aloha")
pytest.importorskip("pyarrow")

from fluxvla_core.cli.main import main
from fluxvla_core.config.load import load_config
from fluxvla_core.plugins.registry import load_plugin_files

from .tiny import HORIZON, tiny

QUICK = (("act", 1), ("diffusion", 4))
COLUMNS = 60
LENGTH = 24
PLUGIN = Path(__file__).with_name("odd_robot.py")


@pytest.fixture
def odd_robot() -> Any:
    """Its classes are registered, here and in worker processes."""
    load_plugin_files([PLUGIN])
    return sys.modules["fluxvla_plugin_odd_robot"]


def recorded(root: Path, odd_robot: Any, cameras: int) -> Path:
    """Two episodes of LeRobot v2.0 with images in their tables: a video has no odd sides."""
    import cv2
    import pyarrow as pa
    import pyarrow.parquet as pq

    rng = np.random.default_rng(0)
    kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    names = [f"observation.images.eye_{camera}" for camera in range(cameras)]
    for episode in range(2):
        moves = rng.normal(0, 0.03, (LENGTH + 1, odd_robot.JOINTS)).cumsum(0).astype(np.float32)
        places = np.arange(LENGTH)
        columns: dict[str, Any] = {
            key: pa.FixedSizeListArray.from_arrays(pa.array(rows.ravel()), odd_robot.JOINTS)
            for key, rows in (("observation.state", moves[:-1]), ("action", moves[1:]))
        }
        columns |= {
            "timestamp": (places / odd_robot.RATE).astype(np.float32),
            "frame_index": places,
            "episode_index": np.full(LENGTH, episode),
            "index": places + LENGTH * episode,
            "task_index": np.zeros(LENGTH, np.int64),
        }
        seen = [odd_robot.images(cameras, state) for state in moves[:-1]]
        for name in names:
            frames = (each[name.rpartition(".")[2]] for each in seen)
            stored = [cv2.imencode(".png", image[..., ::-1])[1].tobytes() for image in frames]
            rows = [{"bytes": data, "path": None} for data in stored]
            columns[name] = pa.array(rows, kind)
        file = root / f"data/chunk-000/episode_{episode:06d}.parquet"
        file.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(columns), file)
    describe(root, odd_robot, names)
    return root


def describe(root: Path, odd_robot: Any, cameras: list[str]) -> None:
    joints = [f"joint_{i}" for i in range(odd_robot.JOINTS)]
    row = {"dtype": "float32", "shape": [odd_robot.JOINTS], "names": joints}
    number = {"dtype": "int64", "shape": [1], "names": None}
    image = {
        "dtype": "image",
        "shape": [odd_robot.HEIGHT, odd_robot.WIDTH, 3],
        "names": ["height", "width", "channels"],
    }
    indices = ("frame_index", "episode_index", "index", "task_index")
    info = {
        "codebase_version": "v2.0",
        "robot_type": "odd",
        "total_episodes": 2,
        "total_frames": 2 * LENGTH,
        "total_tasks": 1,
        "total_videos": 0,
        "total_chunks": 1,
        "chunks_size": 1000,
        "fps": odd_robot.RATE,
        "splits": {"train": "0:2"},
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": None,
        "features": {
            "observation.state": row,
            "action": row,
            "timestamp": {**number, "dtype": "float32"},
            **dict.fromkeys(indices, number),
            **dict.fromkeys(cameras, image),
        },
    }
    words = [odd_robot.INSTRUCTION]
    episodes = [{"episode_index": i, "tasks": words, "length": LENGTH} for i in range(2)]
    lines = {"episodes": episodes, "tasks": [{"task_index": 0, "task": words[0]}]}
    (root / "meta").mkdir()
    (root / "meta" / "info.json").write_text(json.dumps(info))
    for name, rows in lines.items():
        text = "".join(f"{json.dumps(line)}\n" for line in rows)
        (root / "meta" / f"{name}.jsonl").write_text(text)


def odd(family: str, folder: Path, odd_robot: Any, cameras: int) -> Path:
    """The family's config for the odd robot; ACT and Diffusion see its images unresized."""
    file = tiny(family, folder, recorded(folder / "data", odd_robot, cameras))
    tree = load_config(file).tree
    model, loader = tree["model"], tree["train_dataloader"]
    sizes = {"action_dim": odd_robot.JOINTS, "state_dim": odd_robot.JOINTS}
    if family == "llava":
        model["vision_backbone"]["num_cameras"] = cameras
        model["vla_head"] |= sizes
    else:
        model |= {"num_cameras": cameras, **sizes}
    loader["per_device_num_workers"] = 2
    table = loader["dataset"]
    table["img_keys"] = [f"eye_{camera}" for camera in range(cameras)]
    table["embodiment"] = odd_robot.robot(cameras).to_dict()
    if family != "llava":
        kept = [t for t in table["transforms"] if t["type"] != "ResizeImages"]
        assert len(kept) < len(table["transforms"])
        table["transforms"] = kept
    tree["eval"] = {
        "type": "EvalRunner",
        "environment": {"type": "OddWorld", "cameras": cameras},
        "episodes": 2,
        "replan_every": HORIZON // 2,
        "record_videos": 1,
    }
    tree["inference"] = {
        "type": "AlohaInferenceRunner",
        "task_descriptions": {"1": odd_robot.INSTRUCTION},
        "execute_horizon": HORIZON // 2,
        "max_publish_step": 20,
        "operator": {"type": "OddOperator", "cameras": cameras},
    }
    file.write_text("".join(f"{name} = {value!r}\n" for name, value in tree.items()))
    return file


@pytest.mark.skipif(sys.platform != "linux", reason="opens a pseudo-terminal")
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("family", "cameras"),
    [
        pair if pair in QUICK else pytest.param(*pair, marks=pytest.mark.slow)
        for pair in product(("llava", "act", "diffusion"), (1, 4))
    ],
)
def test_a_robot_of_odd_shapes(family: str, cameras: int, odd_robot: Any, tmp_path: Path) -> None:
    from tests.cli.test_reporters import behind_a_terminal

    config = odd(family, tmp_path, odd_robot, cameras)
    work = tmp_path / "work"
    words = ["run", "--config", str(config), "--work-dir", str(work)]

    command = [sys.executable, "-m", "fluxvla_core", *words, "--section", "runner"]
    command += ["--plugin", str(PLUGIN)]
    text = behind_a_terminal(command, COLUMNS)
    drawn = [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", part) for part in re.split(r"[\r\n]+", text)]
    bars = [line for line in drawn if line.startswith("train ")]
    assert bars
    assert max(map(len, bars)) <= COLUMNS
    assert any("4/4" in line for line in bars)

    assert main([*words, "--section", "eval", "--nproc", "2"]) == 0
    results = json.loads((work / "eval" / "results.json").read_text())
    assert results["groups"]["policy"]["all"]["episodes"] == 2
    assert list((work / "eval").rglob("*.mp4"))

    assert main([*words, "--section", "inference", "--task", "1"]) == 0
    (trace,) = (work / "inference").rglob("trace.jsonl")
    rows = [json.loads(line) for line in trace.read_text().splitlines()]
    sent = np.array([row["command"] for row in rows if row.get("event") == "command"])
    assert sent.shape[1] == odd_robot.JOINTS
    assert len(sent) >= 20  # and what brakes the arm
    assert np.isfinite(sent).all()
