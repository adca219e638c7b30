"""From recordings to a dataset: what a row holds, what is refused, and that it trains."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fluxvla_core.cli.main import main
from fluxvla_core.data.columns import read_columns
from fluxvla_core.data.inspection import validate
from fluxvla_core.data.metadata import read_metadata
from fluxvla_core.errors import DataError, SpecMismatch
from fluxvla_core.robot.recording.recorded import open_recording
from fluxvla_core.robot.recording.to_dataset import recordings_to_dataset, row_times
from fluxvla_core.spec import Camera, EmbodimentSpec

pytest.importorskip("rosbags")
pytest.importorskip("av")
pytest.importorskip("pyarrow")


class Said:
    def __init__(self) -> None:
        self.lines: list[str] = []

    def info(self, text):
        self.lines.append(text)

    def warn(self, text):
        self.lines.append(f"warning: {text}")

    def progress(self, name, done, total, **fields):
        return

    def event(self, kind, **fields):
        return

    def artifact(self, kind, path):
        return


@pytest.fixture(scope="module")
def recordings(make_bench, tmp_path_factory):
    """Two episodes at 50 Hz, of two tasks; the second one succeeds."""
    root = tmp_path_factory.mktemp("rec")
    for task, goal in (("1", None), ("2", 0.3)):
        bench = make_bench(tmp_path_factory.mktemp("bench"))
        bench.arm.get_state = lambda bench=bench: bench.arm.state
        bench.arm.goal = goal
        bench.run(
            task=task, record=str(root), record_fps=50, prepare_pose=[0.1, 0, 0.5],
            max_publish_step=40,
        )  # fmt: skip
    return root


def columns(root):
    meta = read_metadata(root)
    return meta, read_columns(meta, meta.vectors)


def test_a_row_holds_what_was_known_then_and_what_was_commanded_next(recordings, tmp_path):
    out = recordings_to_dataset([recordings], tmp_path / "data")

    meta, found = columns(out)
    assert meta.fps == 50
    assert len(meta.episodes) == 2
    assert list(meta.tasks) == ["wave at the camera", "lift the red cube"]
    first = open_recording(recordings / "001-1")
    times, commands = first.commands("run")
    rows = np.flatnonzero(found["episode_index"] == 0)
    assert len(rows) == len(commands) == 40
    np.testing.assert_allclose(found["action"][rows], commands, atol=1e-6)
    # The arm is where it was commanded to be: at each row, where the command before it led.
    np.testing.assert_allclose(found["observation.state"][rows[1:]], commands[:-1], atol=1e-6)
    np.testing.assert_allclose(np.diff(row_times(first, 50)), 0.02)
    assert row_times(first, 50)[0] == pytest.approx(times[0] - 0.02)
    assert validate(out) == []


def test_images_belong_to_their_rows(recordings, tmp_path):
    from fluxvla_core.data.dataset import ParquetDataset

    out = recordings_to_dataset([recordings / "001-1"], tmp_path / "data")

    found = ParquetDataset(str(out), [], ["front"])
    first = open_recording(recordings / "001-1")
    for row in (0, 7, 30):
        image = first.images["front"].read(first.images["front"].newest(row_times(first, 50)[row]))
        seen = np.asarray(found[row]["images"][0], dtype=np.float64)
        assert abs(seen.mean() - image.mean()) < 3  # h264 is not exact
    assert found.embodiment.joint_names == ("shoulder", "elbow", "jaw")
    assert found[0]["task_description"] == "wave at the camera"


def test_fewer_rows_a_second_take_the_command_at_the_next_row(recordings, tmp_path):
    said = Said()
    out = recordings_to_dataset([recordings / "001-1"], tmp_path / "data", fps=10, reporter=said)

    _, found = columns(out)
    _, commands = open_recording(recordings / "001-1").commands("run")
    np.testing.assert_allclose(found["action"], commands[4::5], atol=1e-6)
    assert said.lines == []


def test_rows_that_show_an_image_again_are_said(make_bench, tmp_path):
    bench, said = make_bench(tmp_path), Said()
    bench.run(record=str(tmp_path / "rec"), record_fps=10, max_publish_step=50)

    recordings_to_dataset([tmp_path / "rec"], tmp_path / "data", reporter=said)

    (line,) = said.lines
    assert "50 rows show 10 images of front; --fps 10 would show each once" in line


def test_those_that_failed_can_be_left_out(recordings, tmp_path):
    said = Said()
    out = recordings_to_dataset([recordings], tmp_path / "data", successes=True, reporter=said)

    assert list(read_metadata(out).tasks) == ["lift the red cube"]
    assert said.lines == ["1 of 2 recordings are not known to have succeeded; left out"]
    with pytest.raises(DataError, match="of 1 recordings none is left"):
        recordings_to_dataset([recordings / "001-1"], tmp_path / "none", successes=True)


def test_what_cannot_be_done_is_refused(recordings, make_bench, make_arm, tmp_path):
    with pytest.raises(DataError, match="--fps 60: testarm was commanded 50 times a second"):
        recordings_to_dataset([recordings], tmp_path / "data", fps=60)
    with pytest.raises(DataError, match="there is no recorded episode here"):
        recordings_to_dataset([tmp_path], tmp_path / "data")
    bench = make_bench(tmp_path / "b")
    bench.run(max_publish_step=5)
    with pytest.raises(DataError, match="this episode has no images") as caught:
        recordings_to_dataset([tmp_path / "b" / "inference"], tmp_path / "data")
    assert "--record DIR" in str(caught.value)
    spec = bench.arm.embodiment.to_dict()
    joints = [{**joint, "name": f"x_{joint['name']}"} for joint in spec["joints"]]
    other = EmbodimentSpec.from_dict({**spec, "joints": joints})
    bench.arm = make_arm(embodiment=other)
    bench.policy.embodiment = other
    bench.run(record=str(tmp_path / "other"), max_publish_step=5)
    with pytest.raises(SpecMismatch, match="recording 001-1"):
        recordings_to_dataset([recordings / "001-1", tmp_path / "other"], tmp_path / "data")
    assert not (tmp_path / "data").exists()


def test_an_episode_in_which_nothing_was_done_is_left_out_and_said(
    recordings, make_bench, tmp_path
):
    bench, said = make_bench(tmp_path / "b"), Said()
    bench.policy.faults[1] = lambda chunk: chunk * np.nan
    with pytest.raises(Exception, match="not finite"):
        bench.run(record=str(tmp_path / "rec"))

    recordings_to_dataset([tmp_path / "rec", recordings], tmp_path / "data", reporter=said)

    assert any("nothing was done in it; left out" in line for line in said.lines)


def test_a_camera_that_only_some_recordings_have_is_left_out(make_bench, make_arm, tmp_path):
    spec = EmbodimentSpec.from_dict(make_bench(tmp_path).arm.embodiment.to_dict())
    cameras = (*spec.cameras, Camera("wrist", 16, 16))
    both = EmbodimentSpec(spec.name, spec.joints, cameras, spec.rate_hz)
    for number in range(2):
        bench = make_bench(tmp_path / str(number))
        bench.arm = make_arm(embodiment=both)
        bench.policy.cameras = ("front",)
        if number:
            look = bench.arm.get_frame

            def only_front(look=look):
                frame = look()
                del frame.images["wrist"]
                return frame

            bench.arm.get_frame = only_front
        bench.run(record=str(tmp_path / "rec"), max_publish_step=10)

    out = recordings_to_dataset([tmp_path / "rec"], tmp_path / "data", fps=10)

    assert list(read_metadata(out).cameras) == ["observation.images.front"]


VLA = """
import torch
from fluxvla_core import VLAS
import fluxvla_core.testing.training  # registers OneProcessRunner

@VLAS.register_module()
class RecordedVLA(torch.nn.Module):
    action_shape = (5, 3)

    def __init__(self):
        super().__init__()
        self.head = torch.nn.Linear(3 + 3, 15)

    def forward(self, images, states, actions, action_masks, **rest):
        seen = images.float().mean((2, 3)) / 255
        found = self.head(torch.cat([seen, states], 1)).unflatten(1, (5, 3))
        return {"loss": ((found - actions).square().mean(-1) * action_masks).mean()}

    def fsdp_units(self):
        return []
"""
CONFIG = """
model = dict(type="RecordedVLA")
train_dataloader = dict(per_device_batch_size=8, per_device_num_workers=0, dataset=dict(
    type="ParquetDataset", data_root_path={data!r}, img_keys=["front"], action_window_size=5,
    transforms=[dict(type="SimpleNormalizeImages"),
                dict(type="NormalizeStatesAndActions", norm_type="mean_std", std_floor=0.02)]))
runner = dict(
    type="OneProcessRunner", max_steps=3, learning_rate=1e-3,
    collator=dict(type="DictCollator", keys=["images", "states", "actions", "action_masks"],
                  meta_keys=["img_masks", "sample_ids", "task_description", "info", "stats",
                             "timestamp"]),
    metric=dict(type="VLAMetric", active_trackers=("jsonl",)))
"""


def test_the_commands_say_so_and_a_policy_trains_on_it(recordings, tmp_path, capsys):
    pytest.importorskip("torch")
    data = tmp_path / "data"
    assert main(["data", "convert", str(recordings), str(data), "--fps", "10"]) == 0
    assert f"dataset: {data}" in capsys.readouterr().out
    assert main(["data", "validate", str(data)]) == 0
    (tmp_path / "vla.py").write_text(VLA)
    (tmp_path / "cfg.py").write_text(CONFIG.format(data=str(data)))
    words = ["run", "--config", tmp_path / "cfg.py", "--section", "runner"]
    words += ["--plugin", tmp_path / "vla.py", "--work-dir", tmp_path / "work"]

    assert main([str(word) for word in words]) == 0

    rows = (tmp_path / "work" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(row)["step"] for row in rows] == [1, 2, 3]
    (found,) = Path(tmp_path / "work" / "checkpoints").glob("*3")
    embodiment = json.loads((found / "embodiment.json").read_text())
    assert embodiment["name"] == "testarm"


def test_a_dataset_is_converted_alone(recordings, tmp_path, capsys):
    (tmp_path / "old" / "meta").mkdir(parents=True)
    words = ["data", "convert", str(tmp_path / "old"), str(recordings), str(tmp_path / "out")]

    assert main(words) == 2

    assert "is a dataset: one is converted, alone, as it is" in capsys.readouterr().err
