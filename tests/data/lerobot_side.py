"""What LeRobot does in the oracle test; runs in an environment that has LeRobot and not FluxVLA.

python lerobot_side.py write TAKES.npz ROOT CODEC
python lerobot_side.py read ROOT OUT.npz
python lerobot_side.py convert ROOT
"""

from __future__ import annotations

import json
import os
import sys

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.v30.convert_dataset_v21_to_v30 import convert_dataset

CAMERAS = ("top", "wrist")
WINDOW = 4


def write(takes_file: str, root: str, codec: str) -> None:
    takes = np.load(takes_file)
    names = takes["names"].tolist()
    features: dict[str, dict[str, object]] = {
        f"observation.images.{camera}": {
            "dtype": "image" if codec == "png" else "video",
            "shape": takes[f"0/{camera}"].shape[1:],
            "names": ["height", "width", "channels"],
        }
        for camera in CAMERAS
    }
    for key in ("observation.state", "action"):
        features[key] = {"dtype": "float32", "shape": (len(names),), "names": names}
    how = {"use_videos": False} if codec == "png" else {"vcodec": codec}
    dataset = LeRobotDataset.create("test/oracle", 10, features, root, "arm", **how)
    for episode, task in enumerate(takes["tasks"].tolist()):
        for i in range(len(takes[f"{episode}/state"])):
            dataset.add_frame(
                {
                    **{f"observation.images.{c}": takes[f"{episode}/{c}"][i] for c in CAMERAS},
                    "observation.state": takes[f"{episode}/state"][i],
                    "action": takes[f"{episode}/action"][i],
                    "task": task,
                }
            )
        dataset.save_episode()
    dataset.finalize()
    for thread in os.listdir("/proc/self/task"):  # the AV1 encoder made them real-time ones
        os.sched_setscheduler(int(thread), os.SCHED_OTHER, os.sched_param(0))


def read(root: str, out: str) -> None:
    steps = {"action": [j / 10 for j in range(WINDOW)]}
    dataset = LeRobotDataset("test/oracle", root, delta_timestamps=steps)
    rows = [dataset[i] for i in range(len(dataset))]
    arrays = {
        key: torch.stack([row[key] for row in rows]).numpy()
        for key in ("observation.state", "action", "action_is_pad", "timestamp", "episode_index")
    }
    for camera in CAMERAS:
        frames = torch.stack([row[f"observation.images.{camera}"] for row in rows])
        arrays[camera] = (frames * 255).round().to(torch.uint8).numpy()
    described = {
        "tasks": [row["task"] for row in rows],
        "fps": dataset.fps,
        "robot_type": dataset.meta.robot_type,
        "episodes": dataset.num_episodes,
        "names": dataset.features["action"]["names"],
        "stats": {
            key: {name: value.tolist() for name, value in entry.items()}
            for key, entry in dataset.meta.stats.items()
        },
    }
    np.savez(out, described=json.dumps(described), **arrays)


def convert(root: str) -> None:
    """Version 2.1 to 3.0, in place."""
    parent, name = os.path.split(root)
    convert_dataset(name, root=parent, push_to_hub=False)


def main(jobs_file: str) -> None:
    commands = {"write": write, "read": read, "convert": convert}
    with open(jobs_file, encoding="utf-8") as file:
        for name, *words in json.load(file):
            commands[name](*words)


if __name__ == "__main__":
    main(sys.argv[1])
