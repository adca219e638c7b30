"""Real ``.rrd`` files: written by the hook, read back by Rerun's own reader."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fluxvla_rerun.hook import ROBOT, STEP, RerunViewer

from fluxvla_core import HOOKS, EmbodimentSpec, Joint, RunContext
from fluxvla_core.commands import SilentReporter
from fluxvla_core.errors import ConfigError
from fluxvla_core.hooks import HookCaller, build_hooks

pa = pytest.importorskip("pyarrow")
rerun = pytest.importorskip("rerun")
chunks = pytest.importorskip("rerun.chunk", reason="this Rerun cannot read what it wrote")

ARM = EmbodimentSpec(
    name="arm",
    joints=tuple(
        Joint(name, "rad", lower=-1.0, upper=1.0, velocity=1.0, acceleration=4.0)
        for name in ("waist", "elbow")
    ),
    cameras=(),
    rate_hz=20.0,
)
IMAGE = np.random.default_rng(0).integers(0, 255, (24, 32, 3), dtype=np.uint8)


class Notes(SilentReporter):
    def __init__(self) -> None:
        self.warnings: list[str] = []

    def warn(self, text: str) -> None:
        self.warnings.append(text)


def run(folder: Path, play: Any = None, **settings: Any) -> tuple[RerunViewer, Notes]:
    """A run with the hook: on a robot, or what ``play`` tells."""
    notes, hook = Notes(), RerunViewer(**settings)
    context = RunContext(work_dir=folder, config_file="a.py", section="inference", reporter=notes)
    caller = HookCaller(context, [("RerunViewer", hook)])
    (play or on_a_robot)(caller)
    return hook, notes


def on_a_robot(hooks: HookCaller) -> None:
    hooks.call("run_started", embodiment=ARM)
    hooks.call("episode_started", task="wave", stamp=1.0)
    images = {"front": IMAGE, "wrist": None}
    seen = {"images": images, "qpos": np.array([0.1, 0.2], np.float32), "task": "wave"}
    hooks.call("observed", observation=seen, stamp=1.5)
    hooks.call("inferred", chunk=np.ones((4, 2)), latency_s=0.03, stamp=1.6)
    for i in range(3):
        sent = {"action": np.array([0.5, i]), "target": np.array([0.6, i + 1.0])}
        state = np.array([0.4, i]) if i == 2 else None
        hooks.call("action_sent", stamp=2.0 + i, state=state, **sent)
    hooks.call("stopped", rule="tracking", problem="elbow is blocked", stamp=5.0)
    hooks.call("episode_finished", reason="failed", stamp=6.0)
    hooks.call("run_finished", outcome="failed")


def _numbers(column: pa.Array) -> pa.Array:
    """Times as whole nanoseconds: Python's own have no more than microseconds."""
    timed = pa.types.is_temporal(column.type)
    return column.cast(pa.int64()) if timed else column


def read(path: Path) -> Mapping[str, list[dict[str, Any]]]:
    """Entity -> the rows of its chunks, in the order of their time."""
    found: dict[str, list[dict[str, Any]]] = {}
    for chunk in chunks.RrdReader(path).stream():
        batch = chunk.to_record_batch()
        columns = [_numbers(column).to_pylist() for column in batch.columns]
        rows = [
            dict(zip(batch.schema.names, row, strict=True)) for row in zip(*columns, strict=True)
        ]
        found.setdefault(chunk.entity_path, []).extend(rows)
    for rows in found.values():
        rows.sort(key=lambda row: row.get("log_time") or 0)
    return found


def numbers(rows: list[dict[str, Any]]) -> list[tuple[float, float]]:
    """(seconds on the robot's clock, value) of scalars."""
    return [(row[ROBOT] / 1e9, row["Scalars:scalars"][0]) for row in rows]


def test_a_run_on_a_robot_is_written_and_read_back(tmp_path: Path) -> None:
    hook, notes = run(tmp_path, jpeg_quality=None)
    assert notes.warnings == []
    assert hook.path == tmp_path / "run.rrd"
    found = read(hook.path)
    assert {name for name in found if not name.startswith("/__")} == {
        "/cameras/front",
        *(
            f"/joints/{j}/{w}"
            for j in ("waist", "elbow")
            for w in ("measured", "target", "command")
        ),
        "/policy/chunk",
        "/policy/latency_s",
        "/events",
    }
    (image,) = found["/cameras/front"]
    assert image[ROBOT] == 1_500_000_000
    pixels = np.frombuffer(bytes(image["Image:buffer"][0]), np.uint8)
    np.testing.assert_array_equal(pixels.reshape(IMAGE.shape), IMAGE)
    assert numbers(found["/joints/elbow/command"]) == [(2.0, 0.0), (3.0, 1.0), (4.0, 2.0)]
    assert numbers(found["/joints/elbow/target"]) == [(2.0, 1.0), (3.0, 2.0), (4.0, 3.0)]
    measured = numbers(found["/joints/waist/measured"])
    np.testing.assert_allclose(measured, [(1.5, 0.1), (4.0, 0.4)], rtol=1e-6)
    assert numbers(found["/policy/latency_s"]) == [(1.6, 0.03)]
    (chunk,) = found["/policy/chunk"]
    assert chunk["Tensor:data"][0]["shape"] == [4, 2]
    assert [(row["TextLog:text"][0], row["TextLog:level"][0]) for row in found["/events"]] == [
        ("run of a.py, section 'inference'", "INFO"),
        ("episode: wave", "INFO"),
        ("stopped (tracking): elbow is blocked", "WARN"),
        ("episode over: failed", "INFO"),
        ("run: failed", "WARN"),
    ]


def test_images_are_compressed_unless_every_bit_is_asked_for(tmp_path: Path) -> None:
    hook, _ = run(tmp_path)
    assert hook.path is not None
    (row,) = read(hook.path)["/cameras/front"]
    assert row["EncodedImage:media_type"] == ["image/jpeg"]
    assert bytes(row["EncodedImage:blob"][0])[:2] == b"\xff\xd8"


def test_the_metrics_of_a_training(tmp_path: Path) -> None:
    def train(hooks: HookCaller) -> None:
        hooks.call("run_started", embodiment=None)
        for step in (10, 20):
            hooks.call("after_step", step=step, metrics={"loss": 1.0 / step, "phase": "warm"})
        hooks.call("checkpoint_saved", path=Path("checkpoints/step-20"), step=20)
        hooks.call("run_finished", outcome="ok")

    hook, notes = run(tmp_path, train)
    assert notes.warnings == []
    assert hook.path is not None
    found = read(hook.path)
    assert [(r[STEP], r["Scalars:scalars"][0]) for r in found["/training/loss"]] == [
        (10, 0.1),
        (20, 0.05),
    ]
    assert "/training/phase" not in found
    assert "saved step-20" in [row["TextLog:text"][0] for row in found["/events"]]


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    first, second, third = (run(tmp_path, file="rrd/a.rrd")[0].path for _ in range(3))
    assert [p.name for p in (first, second, third) if p] == ["a.rrd", "a-2.rrd", "a-3.rrd"]


def test_joints_without_names_are_numbered(tmp_path: Path) -> None:
    def play(hooks: HookCaller) -> None:
        hooks.call("run_started", embodiment=ARM)
        sent = {"action": np.zeros(3), "target": np.zeros(3)}
        hooks.call("action_sent", stamp=0.0, state=None, **sent)
        hooks.call("run_finished", outcome="ok")

    hook, _ = run(tmp_path, play)
    assert hook.path is not None
    assert {f"/joints/{i}/command" for i in range(3)} <= set(read(hook.path))


def test_a_viewer_that_does_not_answer_is_told_and_the_file_is_written(tmp_path: Path) -> None:
    with socket.socket() as taken:  # bound and not listening
        taken.bind(("127.0.0.1", 0))
        url = f"rerun+http://127.0.0.1:{taken.getsockname()[1]}/proxy"
        hook, notes = run(tmp_path, viewer=url)
    assert notes.warnings == [
        f"RerunViewer: no viewer answers at {url}; this run is in {hook.path} alone"
    ]
    assert hook.path is not None
    assert "/joints/elbow/command" in read(hook.path)


SERVER = """
import sys, time, rerun
rerun.init("server")
print(rerun.serve_grpc(grpc_port=int(sys.argv[1])), flush=True)
time.sleep(120)
"""


def test_a_viewer_that_answers_is_sent_all(tmp_path: Path) -> None:
    """What hosts the data for viewers stands for one: to flush is to have all of it sent there."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = [sys.executable, "-c", SERVER, str(port)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            url = server.stdout.readline().strip()
            assert str(port) in url
            _, notes = run(tmp_path, viewer=url, file=None)
        finally:
            server.kill()
    assert notes.warnings == []


@pytest.mark.parametrize(
    "wrong",
    [
        {"file": None},
        {"file": "/tmp/a.rrd"},
        {"file": "../a.rrd"},
        {"viewer": "localhost:9876"},
        {"jpeg_quality": 0},
    ],
)
def test_what_cannot_be_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="RerunViewer: "):
        RerunViewer(**wrong)


def test_a_config_names_it(tmp_path: Path) -> None:
    assert HOOKS.get("RerunViewer") is RerunViewer
    hooks = [{"type": "RerunViewer", "viewer": "rerun+http://host:9876/proxy", "file": None}]
    assert build_hooks(RunContext(config={"hooks": hooks}, work_dir=tmp_path))
