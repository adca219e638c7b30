"""A run with ``record``: one bag an episode, whole after every ending, read back as it was."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from fluxvla_core.control.safety import BadChunk
from fluxvla_core.errors import DataError, RunFailed
from fluxvla_core.robot.recording.recorded import (
    find_recordings,
    finish_recording,
    open_recording,
)
from fluxvla_core.robot.robot import Robot

rosbags = pytest.importorskip("rosbags")


def recorded(bench, **arguments):
    bench.run(record=str(bench.work_dir / "rec"), **arguments)
    return open_recording(bench.work_dir / "rec")


def connections(folder: Path) -> dict[str, tuple[str, int]]:
    from rosbags.highlevel import AnyReader

    with AnyReader([folder]) as reader:
        return {c.topic: (c.msgtype, c.msgcount) for c in reader.connections}


def test_an_episode_is_a_bag_that_ros_tools_open(bench):
    bench.run(record=str(bench.work_dir / "rec"), record_fps=10)

    folder = bench.work_dir / "rec" / "001-1"
    assert sorted(p.name for p in folder.iterdir()) == [
        "001-1.mcap", "episode.json", "front.mp4", "metadata.yaml",
    ]  # fmt: skip
    assert connections(folder) == {
        "/fluxvla/events": ("std_msgs/msg/String", 69),
        "/fluxvla/camera/front": ("sensor_msgs/msg/Image", 13),
        "/fluxvla/state": ("sensor_msgs/msg/JointState", 4),
        "/fluxvla/target": ("sensor_msgs/msg/JointState", 60),
        "/fluxvla/command": ("sensor_msgs/msg/JointState", 60),
        "/fluxvla/chunk": ("trajectory_msgs/msg/JointTrajectory", 3),
    }
    assert not (bench.work_dir / "inference").exists()


def test_ros_messages_say_which_joints_and_when(bench):
    from rosbags.highlevel import AnyReader

    began = time.time()
    bench.run(record=str(bench.work_dir / "rec"), max_publish_step=5)

    with AnyReader([bench.work_dir / "rec" / "001-1"]) as reader:
        found = {
            c.topic: (t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()
        }
    stamp, command = found["/fluxvla/command"]
    assert command.name == ["shoulder", "elbow", "jaw"]
    np.testing.assert_array_equal(command.position, bench.arm.sent[-1])
    assert command.header.stamp.sec == stamp // 10**9
    assert began - 1 < stamp / 1e9 < time.time() + 1  # real time, 0.1 simulated seconds later
    _, chunk = found["/fluxvla/chunk"]
    assert chunk.joint_names == command.name
    assert [p.time_from_start.nanosec for p in chunk.points[:2]] == [10**8, 2 * 10**8]
    _, image = found["/fluxvla/camera/front"]
    assert (image.height, image.width, image.encoding) == (24, 32, "rgb8")
    assert image.header.frame_id == "front"


def test_what_is_read_back_is_what_happened(bench):
    found = recorded(bench, max_publish_step=30)

    assert found.finished
    assert (found.instruction, found.success) == ("wave at the camera", False)
    times, commands = found.commands()
    np.testing.assert_array_equal(commands, bench.arm.sent)
    np.testing.assert_allclose(np.diff(times), 0.02, atol=1e-9)
    assert [len(chunk) for chunk in found.chunks()] == [5] * len(bench.policy.asked)
    seen = [event["t"] for event in found.of("observation")]
    for asked, at in zip(bench.policy.asked, seen[1:], strict=True):  # the first is of the start
        index = found.images["front"].newest(at)
        np.testing.assert_array_equal(found.images["front"].read(index), asked["images"]["front"])
    summary = json.loads((found.path / "episode.json").read_text())
    assert summary.pop("dropped") == {"frames": 0, "images": 0, "events": 0}
    assert summary == found.summary()


def test_depth_and_base_are_recorded_and_read_back(bench, make_rover):
    from rosbags.highlevel import AnyReader

    bench.arm = make_rover()
    found = recorded(bench, max_publish_step=30)

    seen = found.of("observation")
    for event in seen:
        index = found.images["front"].newest(event["stamps"]["front"])
        count = int(found.images["front"].read(index)[0, 0, 0])
        assert event["base"] == make_rover.speeds(count)
        index = found.depths["front"].newest(event["stamps"]["front_depth"])
        np.testing.assert_array_equal(found.depths["front"].read(index), make_rover.depth(count))
    assert event["base"][0] > 0
    topics = connections(found.path)
    assert topics["/fluxvla/base"] == ("nav_msgs/msg/Odometry", len(seen))
    assert topics["/fluxvla/camera/front/depth"] == ("sensor_msgs/msg/Image", len(seen) - 1)
    with AnyReader([found.path]) as reader:
        last = {c.topic: reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()}
    image, odometry = last["/fluxvla/camera/front/depth"], last["/fluxvla/base"]
    assert (image.encoding, image.step, image.header.frame_id) == ("16UC1", 64, "front")
    assert odometry.twist.twist.linear.x == seen[-1]["base"][0]
    assert odometry.pose.covariance[0] < 0, "where it is was not read"


def test_without_a_bag_the_base_is_in_the_lines(bench, make_rover):
    bench.arm = make_rover()
    bench.run(max_publish_step=30)

    seen = open_recording(bench.work_dir / "inference").of("observation")
    assert seen[0]["base"] == [0.0, 0.0]
    assert seen[-1]["base"][0] > 0


def test_lines_and_bag_hold_the_same_events(bench, tmp_path, make_arm):
    found = recorded(bench, max_publish_step=20)
    bench.arm = make_arm()
    bench.run(max_publish_step=20)

    lines = open_recording(bench.work_dir / "inference")

    def facts(events):
        return [{k: v for k, v in e.items() if k not in ("ms", "began")} for e in events]

    assert facts(lines.events) == facts(found.events)
    assert lines.images == {}


@pytest.mark.parametrize(
    ("fault", "rule"), [("raises", "policy"), ("nan", "chunk"), ("send", "operator")]
)
def test_a_recording_is_whole_after_a_fault_and_has_the_cause(bench, fault, rule):
    from fluxvla_core.errors import Faulted

    if fault == "raises":
        bench.policy.faults[2] = ValueError("lost")
    elif fault == "nan":
        bench.policy.faults[2] = lambda chunk: chunk * np.nan
    else:
        bench.arm.faults.update(send_action=Faulted("the drive is off"), after=10)
    with pytest.raises(Exception):  # noqa: B017 - which one is tested elsewhere
        recorded(bench)

    found = open_recording(bench.work_dir / "rec")
    assert found.finished
    assert found.of("end")[0]["trips"][0]["rule"] == rule
    assert found.summary()["outcome"] == "failed"
    assert len(found.commands()[0]) > 5


def test_an_answer_that_was_refused_is_recorded(bench):
    bench.policy.faults[2] = lambda chunk: np.where(np.arange(5)[:, None] == 3, np.inf, chunk)

    with pytest.raises(BadChunk):
        recorded(bench)

    (refused,) = open_recording(bench.work_dir / "rec").of("refused")
    assert refused["what"] == "chunk"
    assert refused["given"]["answer"][3] == ["inf", "inf", "inf"]
    assert refused["given"]["answer"][0][0] > 0


def test_what_fits_nothing_is_recorded_as_text(bench):
    bench.policy.faults[1] = lambda chunk: {"action": chunk[0], "why": object}

    with pytest.raises(BadChunk):
        recorded(bench)

    (refused,) = open_recording(bench.work_dir / "rec").of("refused")
    assert refused["given"]["answer"]["why"] == "<class 'object'>"


def test_a_reading_that_was_refused_is_recorded(bench):
    from fluxvla_core.control.safety import BadFrame

    def fault():
        if len(bench.arm.sent) > 3:
            bench.arm.state = np.array([0.0, np.nan, 0.5])

    bench.arm.faults["get_frame"] = fault
    with pytest.raises(BadFrame):
        recorded(bench)

    (refused,) = open_recording(bench.work_dir / "rec").of("refused")
    assert refused["given"]["state"] == [0.0, "nan", 0.5]
    assert refused["given"]["images"] == {"front": "(24, 32, 3) uint8"}


def test_without_rosbags_nothing_moves(bench, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)

    with pytest.raises(RunFailed, match=r"pip install 'fluxvla-core\[record\]'"):
        bench.run(record="rec")
    assert bench.arm.sent == []


def test_what_is_not_written_in_time_is_dropped_and_said(bench, monkeypatch):
    monkeypatch.setattr("fluxvla_core.robot.recording.trace._WAITING_BYTES", 10)

    bench.run(record=str(bench.work_dir / "rec"), max_publish_step=10)

    (line,) = [line for line in bench.notes.lines if line.startswith("warning")]
    assert "images were not recorded: the disk or the processor did not keep up" in line
    summary = json.loads((bench.work_dir / "rec/001-1/episode.json").read_text())
    assert summary["dropped"]["images"] > 0


class Tapped:
    """``images_after`` of a robot whose camera sends 30 images a second and keeps 2."""

    def __init__(self, arm, hz=30.0, name="images_after"):
        self.arm, self.hz, self.began = arm, hz, time.monotonic()
        setattr(arm, name, self)

    def __call__(self, camera, after):
        arrived = int((time.monotonic() - self.began) * self.hz)
        kept = [self.began + n / self.hz for n in range(max(1, arrived - 1), arrived + 1)]
        shape = next((c.height, c.width, 3) for c in self.arm.embodiment.cameras)
        return [(t, np.zeros(shape, np.uint8)) for t in kept if t > after], arrived


@pytest.mark.realtime
def test_images_that_nobody_looked_at_are_recorded_where_the_robot_keeps_them(bench, make_arm):
    bench.arm = make_arm(realtime=True)
    Tapped(bench.arm)

    found = recorded(bench, max_publish_step=60, record_fps=10)

    times = np.diff(found.images["front"].times)
    arrived = np.count_nonzero(times > 1e-3)  # what was looked at lies in between
    lost = json.loads((found.path / "episode.json").read_text())["dropped"]["images"]
    assert found.native
    assert arrived + lost > 20
    assert (found.path / "front.mp4").stat().st_size > 0


def test_the_old_name_of_images_after_still_works(make_arm):
    arm = make_arm()
    robot = Robot(arm)
    assert robot.images_after is None
    tapped = Tapped(arm, name="pictures_after")
    with pytest.warns(DeprecationWarning, match="pictures_after is deprecated, name it images_a"):
        assert robot.images_after is tapped


KILLED = """
import sys, os, time, signal
sys.path.insert(0, {here!r})
from pathlib import Path
import conftest
bench = conftest.Bench(Path({work!r}))
bench.arm = conftest.Arm(realtime=True)
bench.run(record={record!r}, record_fps=10, max_publish_step=100000)
"""


@pytest.mark.realtime
@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_recording_is_readable_however_the_process_ends(tmp_path, ending):
    record = tmp_path / "rec"
    code = KILLED.format(here=str(Path(__file__).parent), work=str(tmp_path), record=str(record))
    process = subprocess.Popen(
        [sys.executable, "-c", code], stderr=subprocess.PIPE, env={**os.environ}
    )
    until = time.monotonic() + 120
    bag = record / "001-1" / "001-1.mcap"
    while not bag.exists() or bag.stat().st_size < 5_000:
        assert process.poll() is None, process.communicate()[1].decode()
        assert time.monotonic() < until, "nothing was recorded"
        time.sleep(0.02)
    process.send_signal(ending)
    process.communicate(timeout=60)

    found = open_recording(record)
    assert found.finished == (ending != signal.SIGKILL)
    times, commands = found.commands()
    assert len(commands) > 10
    assert len(found.chunks()) > 0
    assert found.images["front"].read(len(found.images["front"]) - 1).shape == (24, 32, 3)
    outcome = "interrupted" if found.finished else "cut short"
    assert found.summary()["outcome"] == outcome
    assert np.diff(times).max() < 5

    assert finish_recording(found.path) != found.finished
    assert open_recording(record).events == found.events
    assert connections(found.path)["/fluxvla/command"][1] == len(commands)
    assert sorted(p.name for p in record.iterdir()) == ["001-1"]


def test_what_is_no_recording_is_said(tmp_path, bench):
    with pytest.raises(DataError, match="there is no recorded episode here") as caught:
        open_recording(tmp_path / "none")
    assert "no such file or folder" in str(caught.value)
    bench.run(record=str(tmp_path / "rec"), max_publish_step=3)
    bench.run(record=str(tmp_path / "rec"), max_publish_step=3)
    with pytest.raises(DataError, match="2 recorded episodes are here; name one of them: 001"):
        open_recording(tmp_path / "rec")
    assert [p.name for p in find_recordings(tmp_path / "rec")] == ["001-1", "002-1"]
