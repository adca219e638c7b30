"""Damaged and forged files of every format: whatever is in them, only a FluxError comes out.

The mutations follow from a seed, so that a failure can be repeated; CI takes a fixed number of
them, the nightly session many more.
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
import random
import shutil
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fluxvla_report.read import read_facts
from safetensors.torch import save

from fluxvla_core import Camera, EmbodimentSpec, Joint
from fluxvla_core.checkpoints.checkpoint import Checkpoint
from fluxvla_core.checkpoints.manifest import FileEntry, Manifest, read_manifest
from fluxvla_core.checkpoints.writer import CheckpointWriter
from fluxvla_core.config.check import examine
from fluxvla_core.config.load import load_config
from fluxvla_core.data import LeRobotWriter, ParquetDataset, Pipeline
from fluxvla_core.data.inspection import validate
from fluxvla_core.data.transforms.state_action import DenormalizePrivateAction
from fluxvla_core.errors import FluxError
from fluxvla_core.evaluation.compare import Evaluated, compare, describe
from fluxvla_core.evaluation.compare import read as read_evaluated
from fluxvla_core.evaluation.episodes import EvalLog
from fluxvla_core.results import open_recording
from fluxvla_core.training.lora import LoraOptions
from fluxvla_core.training.state import Progress, SavedOptimizer, SavedTrainer
from fluxvla_core.training.weights import SavedWeights

CASES = 60
MANY = 3000
SPEC = EmbodimentSpec(
    "arm",
    (Joint("a", "rad", -9.0, 9.0, 1.0, 1.0), Joint("b", "rad", -9.0, 9.0, 1.0, 1.0)),
    (Camera("eye", 32, 32),),
    10.0,
)
ROW = {name: [0.5, 1.0] for name in ("mean", "std", "min", "max", "q01", "q99")}
ODD: tuple[Any, ...] = (
    *(None, True, 0, -1, 1.5, 10**12, 10**30, math.inf, math.nan, 1e308, "", "x", "3", [], {}),
    *([0], [[1, 2], [3]], {"x": 1}, "../../etc/passwd", "/dev/zero", "\x1b[2J", "{0.__class__}"),
    "{chunk_index:0999999999d}",
)


def nodes(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Every place of a JSON value: the table or list, and the key in it."""
    for key, item in list(tree.items() if isinstance(tree, dict) else enumerate(tree)):
        yield tree, key
        if isinstance(item, (dict, list)):
            yield from nodes(item)


def forged(value: Any, rng: random.Random) -> bytes:
    """JSON with one value of another type, a key gone, or one nested deeply."""
    tree = copy.deepcopy(value)
    holder, key = rng.choice(list(nodes(tree)))
    way = rng.random()
    if way < 0.2:
        del holder[key]
    elif way < 0.3 and isinstance(holder, dict):
        holder[str(rng.choice(ODD))] = holder.pop(key)
    else:
        holder[key] = rng.choice(ODD)
    text = json.dumps(tree)
    if way > 0.95:
        text = text.replace(":", ":" + "[" * 5000, 1)
    return text.encode()


def damaged(content: bytes, rng: random.Random) -> bytes:
    """Bytes changed, cut out, put in, or cut off."""
    out = bytearray(content)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(out) + 1)
        way = rng.randrange(5)
        if way == 0:
            del out[at:]
        elif way == 1:
            del out[at : at + rng.randint(1, 20)]
        elif way == 2:
            out[at:at] = rng.randbytes(rng.randint(1, 20))
        elif way == 3:
            out[at : at + 8] = rng.choice((b"\xff" * 8, b"\0" * 8, b"9" * 8))
        elif at < len(out):
            out[at] ^= 1 << rng.randrange(8)
    return bytes(out)


def mutated(content: bytes, rng: random.Random) -> bytes:
    try:
        value = json.loads(content)
    except ValueError:
        if content.startswith((b'{"event"', b'{"format"')):  # JSON lines
            lines = content.splitlines()
            at = rng.randrange(len(lines))
            lines[at] = forged(json.loads(lines[at]), rng)
            return b"\n".join(lines) + b"\n"
        return damaged(content, rng)
    return forged(value, rng) if rng.random() < 0.8 else damaged(content, rng)


def dataset(root: Path) -> Path:
    with LeRobotWriter(root, 10, SPEC) as writer:
        for episode in range(2):
            for i in range(4):
                image = np.full((32, 32, 3), 20 * i, np.uint8)
                writer.add_frame({"eye": image}, [i, episode], [i, -i], f"do {episode}")
            writer.save_episode()
    return root


def read_dataset(root: Path) -> None:
    ParquetDataset(str(root), [], ["eye"])[5]
    validate(root)


def checkpoint(root: Path) -> Path:
    left_out = {"left_out": {"sources": {"x": "y"}, "sha256": "0"}}
    trainer = {
        **Progress(step=3, saved=3).to_dict(),
        **left_out,
        "scheduler": {"step": 3},
        "metric": {},
        "step_samples": 8,
        "world_size": 1,
    }
    with CheckpointWriter(root, 3, 0) as writer:
        writer.write_bytes("model.safetensors", save({"w": torch.ones(2, 2)}))
        writer.write_bytes("optimizer.safetensors", save({"w/exp_avg": torch.ones(2, 2)}))
        writer.write_json("config.resolved.json", {"config": {"model": {"type": "X"}}})
        writer.write_json("embodiment.json", SPEC.to_dict())
        writer.write_json("policy.json", {"action_rate_hz": 10.0, "horizon": 2})
        writer.write_json("dataset_statistics.json", {"private": {"proprio": ROW, "action": ROW}})
        writer.write_json("trainer.json", trainer)
        group = {"params": ["w"], "lr": 0.1}
        writer.write_json("optimizer.json", {"type": "AdamW", "groups": [group], "scalars": {}})
        writer.write_json("adapter/adapter_config.json", LoraOptions(4, ("q",)).for_peft("base"))
        writer.write_json("processors/processors.json", {"package:x": "tokenizer"})
        return writer.commit()


def read_checkpoint(path: Path) -> None:
    found = Checkpoint.open(path)
    found.verify()
    assert isinstance(found.config(), dict)
    found.embodiment()
    rate = found.policy().get("action_rate_hz")
    assert rate is None or (math.isfinite(rate) and rate > 0)
    act = DenormalizePrivateAction(found.statistics())
    act({"action": np.zeros((1, 3, 2)), "states": np.zeros(2)})
    found.json("trainer.json", SavedWeights)
    Progress.from_dict(found.json("trainer.json", SavedTrainer))
    found.json("optimizer.json", SavedOptimizer)
    LoraOptions.of_checkpoint(found)
    found.tensors("model.safetensors")
    for stored in found.optimizer_tensors().values():
        stored[tuple(slice(0, n) for n in stored.shape)]
    Pipeline([], found.processors)


def sign(path: Path, name: str) -> None:
    """Let the manifest say that the file ``name`` is as it was saved."""
    content = (path / name).read_bytes()
    found = read_manifest(path)
    entry = FileEntry(len(content), hashlib.sha256(content).hexdigest())
    manifest = Manifest(found.step, found.epoch, {**found.files, name: entry})
    (path / "manifest.json").write_bytes(manifest.to_bytes())


def config(root: Path) -> Path:
    root.mkdir()
    tree = {"model": {"type": "X"}, "a": [1, {"b": [2, "c"]}], "_base_": []}
    resolved = {"format": "fluxvla-config-1", "config": tree, "origins": {"a": "c.py:1"}}
    (root / "c.json").write_text(json.dumps(resolved))
    (root / "c.toml").write_text(
        "_base_ = 'd.toml'\n[model]\ntype = \"X\"\n[[a.b]]\nc = {d = [1, 2.5, '''x''']}\n"
    )
    (root / "d.toml").write_text("e.f.'g h' = 0x1F\n")
    return root


def read_configs(root: Path) -> None:
    for name in ("c.json", "c.toml"):
        examine(load_config(root / name))


def recording(root: Path) -> Path:
    root.mkdir()
    events = (
        {
            "event": "start",
            "t": 0.0,
            "format": "fluxvla-episode-1",
            "native": False,
            "instruction": "x",
            "task": "1",
            "embodiment": SPEC.to_dict(),
        },
        {"event": "observation", "t": 0.1, "state": [0.0, 1.0], "stamps": {"state": 0.1}},
        {"event": "chunk", "t": 0.2, "keyframes": [[0.0, 1.0]], "ms": {"policy": 3.0}},
        {
            "event": "command",
            "t": 0.3,
            "command": [0.0, 1.0],
            "phase": "run",
            "clamps": [{"joint": "a", "reason": "velocity"}],
        },
        {"event": "end", "t": 0.4, "outcome": "done", "success": True},
    )
    (root / "trace.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))
    return root


def read_recording(root: Path) -> None:
    found = open_recording(root)
    found.commands("run")
    found.states()
    found.chunks()
    found.summary()
    assert isinstance(found.instruction, str)
    assert found.success in (None, True, False)


def evaluation(root: Path) -> Path:
    log = EvalLog(root / "eval" / "episodes.jsonl", {"policy": "p", "settings": {"a": {"b": 1}}})
    for seed in range(3):
        record = {"group": "policy", "task": "lift", "seed": seed, "status": "done"}
        log.add({**record, "success": seed > 0, "steps": 3})
    return root


def read_evaluation(root: Path) -> None:
    record = {"group": "policy", "task": "lift", "status": "done", "success": True}
    records = [{**record, "seed": seed} for seed in range(3)]
    about = {"policy": "q", "settings": {"a": {"b": 1}}}
    describe(compare(read_evaluated(root), Evaluated(root, "policy", about, records)))


def work_dir(root: Path) -> Path:
    (root / "eval").mkdir(parents=True)
    (root / "metrics.jsonl").write_text('{"event": 0, "step": 1, "loss": 2.0}\n' * 3)
    (root / "stages.json").write_text('{"stages": [{"name": "a", "seconds": 1, "command": "b"}]}')
    (root / "environment.json").write_text('{"python": "3"}')
    return root


FORMATS: dict[str, tuple[Callable[[Path], Path], Callable[[Path], object]]] = {
    "dataset": (dataset, read_dataset),
    "checkpoint": (checkpoint, read_checkpoint),
    "config": (config, read_configs),
    "recording": (recording, read_recording),
    "evaluation": (evaluation, read_evaluation),
    "report": (work_dir, read_facts),
}


def fuzz(kind: str, place: Path, cases: int, seed: int) -> int:
    """How many of ``cases`` were refused; anything but a FluxError fails the test."""
    make, read = FORMATS[kind]
    whole = make(place / "whole")
    read(whole)
    inside = whole.relative_to(place / "whole")
    names = sorted(p.relative_to(whole) for p in whole.rglob("*") if p.is_file())
    refused = 0
    target = place / "copy"
    for case in range(cases):
        rng = random.Random(f"{kind} {seed} {case}")
        name = names[case % len(names)]
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(place / "whole", target)
        file = target / inside / name
        file.write_bytes(mutated(file.read_bytes(), rng))
        if kind == "checkpoint" and name.name != "manifest.json":
            sign(target / inside, name.as_posix())
        begin = time.perf_counter()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                read(target / inside)
        except FluxError as error:
            refused += 1
            said = str(error)
        except Exception as error:
            raise AssertionError(f"{kind} {name}, seed {seed}, case {case}: {error!r}") from error
        else:
            said = ""
        assert len(said) < 5000, f"{kind} {name}, seed {seed}, case {case}"
        assert time.perf_counter() - begin < 30, f"{kind} {name}, seed {seed}, case {case}"
    return refused


@pytest.mark.parametrize("kind", FORMATS)
def test_whatever_is_in_a_file_only_a_flux_error_comes_out(kind: str, tmp_path: Path) -> None:
    refused = fuzz(kind, tmp_path, CASES, 0)
    assert refused > CASES // 4 or kind == "report"  # which notes problems


@pytest.mark.slow
@pytest.mark.parametrize("kind", FORMATS)
def test_many_more_mutations(kind: str, tmp_path: Path) -> None:
    fuzz(kind, tmp_path, MANY, 1)
