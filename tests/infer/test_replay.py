"""A recording as robot and as policy: the same episode again."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import pytest

from fluxvla_core.build import build_operator_from_cfg, build_policy_from_cfg
from fluxvla_core.errors import ConfigError, DataError, NotReady, Rejected, SpecMismatch
from fluxvla_core.record.recording import open_recording
from fluxvla_core.record.replay_operator import ReplayOperator
from fluxvla_core.record.replay_policy import RecordingEnded, ReplayPolicy
from fluxvla_core.spec.embodiment import EmbodimentSpec
from fluxvla_core.testing import OperatorConformance

pytest.importorskip("rosbags")


@pytest.fixture(scope="module")
def path(make_bench, tmp_path_factory):
    bench = make_bench(tmp_path_factory.mktemp("recorded"))
    bench.arm.get_state = lambda: bench.arm.state
    bench.run(record=str(bench.work_dir), max_publish_step=60, prepare_pose=[0.1, 0, 0.5])
    return str(bench.work_dir / "001-1")


def again(bench, path, **arguments):
    bench.run(record=str(bench.work_dir / "rec"), prepare_pose=[0.1, 0, 0.5], **arguments)
    return open_recording(path), open_recording(bench.work_dir / "rec")


class TestReplayOperator(OperatorConformance):
    entry_point = "ReplayOperator"
    arguments: ClassVar = {"recording": "there/is/none"}

    @pytest.fixture
    def operator(self, path):
        operator = ReplayOperator(path)
        yield operator
        operator.close()


class TestReplayOperatorInRealTime(OperatorConformance):
    entry_point = "ReplayOperator"
    arguments: ClassVar = {"recording": "there/is/none", "realtime": True}

    @pytest.fixture
    def operator(self, path):
        operator = ReplayOperator(path, realtime=True)
        yield operator
        operator.close()


class Looker:
    """A policy whose answer follows from every pixel and every joint."""

    def __init__(self, embodiment):
        self.embodiment, self.action_rate_hz, self.horizon = embodiment, 10.0, 5

    def reset(self, seed):
        return None

    def predict_action(self, observation):
        pose = np.asarray(observation["qpos"], dtype=np.float64)
        look = float(observation["images"]["front"].mean()) / 255
        return pose + np.linspace(0, 0.05 * look, 5)[:, None]


def test_the_recorded_robot_gives_a_policy_what_it_saw(bench, make_arm):
    bench.policy = Looker(bench.arm.embodiment)
    bench.arm.get_state = lambda: bench.arm.state
    bench.run(record=str(bench.work_dir / "rec"), max_publish_step=60)
    path = str(bench.work_dir / "rec" / "001-1")
    bench.run(
        record=str(bench.work_dir / "rec"), operator={"type": "ReplayOperator", "recording": path}
    )

    first, second = open_recording(path), open_recording(bench.work_dir / "rec" / "002-1")
    assert len(first.chunks()) > 2
    np.testing.assert_array_equal(first.chunks(), second.chunks())
    np.testing.assert_array_equal(first.commands("run")[1], second.commands("run")[1])
    assert second.summary()["outcome"] == "done"
    assert second.success is None or second.success is False
    assert any("ends here" in line for line in bench.notes.lines)


def test_depth_and_base_are_shown_and_recorded_again(bench, make_rover):
    bench.arm = make_rover()
    bench.run(record=str(bench.work_dir / "rec"), max_publish_step=30)
    path = str(bench.work_dir / "rec" / "001-1")
    operator = ReplayOperator(path)
    bench.run(record=str(bench.work_dir / "rec"), operator=operator)

    first, second = open_recording(path), open_recording(bench.work_dir / "rec" / "002-1")
    shown, again = first.of("observation"), second.of("observation")
    assert [event["base"] for event in again] == [event["base"] for event in shown]
    assert len(second.depths["front"]) == len(first.depths["front"]) == 2
    for index in range(len(second.depths["front"])):
        before, after = (found.depths["front"].read(index) for found in (first, second))
        np.testing.assert_array_equal(before, after)
    operator.connect()
    frame = operator.get_frame()
    np.testing.assert_array_equal(frame.depths["front"], make_rover.depth(0))
    assert frame.base.tolist() == make_rover.speeds(0)
    assert frame.stamps["front"] - frame.stamps["front_depth"] == pytest.approx(0.001, abs=1e-6)


def test_the_recorded_actions_give_the_recorded_commands(bench, path, make_arm):
    bench.arm = make_arm()
    bench.arm.get_state = lambda: bench.arm.state
    first, second = again(bench, path, policy={"type": "ReplayPolicy", "recording": path})

    np.testing.assert_array_equal(first.commands()[1], second.commands()[1])
    np.testing.assert_array_equal(first.chunks(), second.chunks())
    assert second.summary()["outcome"] == first.summary()["outcome"] == "max_steps"


def test_after_its_last_answer_a_recording_ends_the_episode(bench, path, make_arm):
    bench.arm = make_arm()
    _, second = again(
        bench, path,
        policy={"type": "ReplayPolicy", "recording": path}, max_publish_step=1000,
    )  # fmt: skip

    assert second.summary()["outcome"] == "recording_ended"
    assert f"the recording {path} ends here" in bench.notes.lines


def test_the_commands_themselves_can_be_replayed(bench, path, make_arm):
    bench.arm = make_arm()
    table = {"type": "ReplayPolicy", "recording": path, "actions": "commands"}
    first, second = again(bench, path, policy=table, max_publish_step=1000)

    np.testing.assert_allclose(
        first.commands("run")[1], second.commands("run")[1], rtol=0, atol=1e-12
    )


def test_lines_of_json_are_enough_for_a_policy(bench, make_arm):
    bench.run(max_publish_step=20)
    path = str(bench.work_dir / "inference" / "001-1")
    sent = bench.arm.sent
    bench.arm = make_arm()
    bench.run(max_publish_step=20, policy=ReplayPolicy(path))

    np.testing.assert_array_equal(bench.arm.sent, sent)
    with pytest.raises(DataError, match="has no pictures: its robot cannot be replayed") as caught:
        bench.run(operator=ReplayOperator(path))
    assert "record anew with --record DIR" in str(caught.value)


@pytest.mark.realtime
def test_on_a_robot_the_answer_that_warms_up_is_not_taken(bench, path, make_arm):
    bench.arm = make_arm(realtime=True)
    first, second = again(bench, path, policy=ReplayPolicy(path), max_publish_step=1000)

    np.testing.assert_array_equal(first.chunks(), second.chunks())


@pytest.mark.realtime
def test_an_answer_that_warms_a_policy_up_leaves_nothing_behind(bench, make_arm):
    bench.arm = make_arm(realtime=True)
    bench.run(max_publish_step=30)

    assert bench.policy.seeds == [7, 7]


@pytest.mark.realtime
def test_a_recording_plays_in_real_time(bench, path):
    found = ReplayOperator(path, realtime=True)
    _, second = again(bench, path, operator=found)

    times, _ = second.commands("run")
    assert times[-1] - times[0] > 0.5 * (60 - 1) / 50  # as fast as possible, it takes 0.1 s
    assert second.summary()["outcome"] == "done"


def test_another_robot_is_refused(bench, path, make_arm):
    other = {**bench.arm.embodiment.to_dict(), "name": "other"}
    other["joints"] = [{**joint, "name": f"x_{joint['name']}"} for joint in other["joints"]]
    with pytest.raises(SpecMismatch, match="the config's embodiment"):
        bench.run(operator=ReplayOperator(path), embodiment=other)
    bench.arm = make_arm(embodiment=EmbodimentSpec.from_dict(other))
    with pytest.raises(SpecMismatch, match="x_shoulder"):
        bench.run(policy=ReplayPolicy(path))
    assert bench.arm.sent == []


def test_another_task_is_said(bench, path):
    bench.run(operator=ReplayOperator(path, context=bench.runner().context), task="2")

    assert any("is of 'wave at the camera', not of 'lift the red cube'" in x
               for x in bench.notes.lines)  # fmt: skip


def test_another_policy_than_the_recorded_one_is_no_tracking_fault(bench, path, make_waver):
    bench.policy = make_waver(goal=-0.8, stride=0.2)

    bench.run(operator=ReplayOperator(path), max_publish_step=1000)

    assert bench.episode()["outcome"] == "done"


def test_a_robot_that_is_not_connected_says_so(path):
    operator = build_operator_from_cfg({"type": "ReplayOperator", "recording": path})
    with pytest.raises(NotReady, match=r"call connect\(\) first"):
        operator.get_frame()
    operator.connect()
    with pytest.raises(Rejected, match="elbow"):
        operator.send_action([0.0, np.nan, 0.0])


def test_elsewhere_a_policy_without_answers_is_an_error(path):
    policy = ReplayPolicy(path)
    policy.reset(0)
    for _ in open_recording(path).chunks():
        policy.predict_action({})
    with pytest.raises(RecordingEnded, match="ends here"):
        policy.predict_action({})


def test_what_a_policy_replays_is_one_of_two():
    with pytest.raises(ConfigError, match="'frames' is neither 'chunks' nor 'commands'"):
        build_policy_from_cfg({"type": "ReplayPolicy", "recording": "x", "actions": "frames"})


def test_an_episode_in_which_nothing_was_done_is_no_policy(bench):
    from fluxvla_core.errors import Faulted

    bench.arm.faults["get_frame"] = Faulted("the camera burns")
    with pytest.raises(Faulted):
        bench.run(record=str(bench.work_dir / "rec"))

    with pytest.raises(DataError, match="holds no chunks: nothing was done in it"):
        ReplayPolicy(str(bench.work_dir / "rec")).horizon  # noqa: B018
    with pytest.raises(DataError, match="no pictures"):
        ReplayOperator(str(bench.work_dir / "rec")).embodiment  # noqa: B018
