"""A recording as robot and as policy: the same episode again."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import pytest

from fluxvla_core.build import build_operator_from_cfg, build_policy_from_cfg
from fluxvla_core.control.clock import SimulatedClock
from fluxvla_core.control.joiners import METHODS
from fluxvla_core.errors import ConfigError, DataError, NotReady, Rejected, SpecMismatch
from fluxvla_core.robot.observations import FreshnessGate
from fluxvla_core.robot.recording.recorded import open_recording
from fluxvla_core.robot.recording.replay import RecordingEnded, ReplayOperator, ReplayPolicy
from fluxvla_core.ros2 import RobotFrame
from fluxvla_core.spec import EmbodimentSpec
from fluxvla_core.testing import OperatorConformance

pytest.importorskip("rosbags")


@pytest.fixture(scope="module")
def path(make_bench, tmp_path_factory):
    bench = make_bench(tmp_path_factory.mktemp("recorded"))
    bench.arm.get_state = lambda: bench.arm.state
    bench.run(record=str(bench.work_dir), max_publish_step=60, prepare_pose=[0.1, 0, 0.5])
    return str(bench.work_dir / "001-1")


def again(bench, path, folder="rec", **arguments):
    bench.run(record=str(bench.work_dir / folder), prepare_pose=[0.1, 0, 0.5], **arguments)
    return open_recording(path), open_recording(bench.work_dir / folder)


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


class Rememberer(Looker):
    """A policy whose answer follows from three observations, of which it keeps sums."""

    n_obs_steps = 3

    def __init__(self, embodiment):
        super().__init__(embodiment)
        self.saw = []

    def predict_action(self, observation):
        shown = [*observation["history"], observation]
        self.saw.append([(float(s["images"]["front"].sum()), *s["qpos"]) for s in shown])
        return super().predict_action({**shown[0], "qpos": observation["qpos"]})


@pytest.mark.parametrize("joining", ["synchronous", "latest_only"])
def test_the_recorded_robot_gives_a_policy_the_history_that_it_had(bench, joining):
    bench.policy = Rememberer(bench.arm.embodiment)
    settings = {"chunk_joining": joining, "execute_horizon": 4, "max_publish_step": 70}
    bench.run(record=str(bench.work_dir / "rec"), **settings)
    path = str(bench.work_dir / "rec" / "001-1")
    live, bench.policy.saw = bench.policy.saw, []
    bench.run(
        record=str(bench.work_dir / "rec"), **settings,
        operator={"type": "ReplayOperator", "recording": path},
    )  # fmt: skip

    first, second = open_recording(path), open_recording(bench.work_dir / "rec" / "002-1")
    assert len({seen for question in live for seen in question}) > len(live) > 3
    assert bench.policy.saw[: len(live)] == live
    np.testing.assert_array_equal(first.chunks(), second.chunks()[: len(live)])


class Streams:
    """A robot whose state and camera come at rates of their own, the images late.

    Args:
        arm: what moves.
    """

    STATE_HZ, CAMERA_HZ, LATE_S = 90.0, 13.0, 0.03

    def __init__(self, arm):
        # Streams were there before anybody looked.
        arm.clock = self.clock = SimulatedClock(1.0)
        self.arm, self.embodiment = arm, arm.embodiment
        self.moved = [(0.0, arm.state)]

    def connect(self):
        return None

    def newest(self, hz, until):
        return max(0.0, np.floor(until * hz) / hz)

    def at(self, time):
        return next(state for when, state in reversed(self.moved) if when <= time)

    def get_state(self):
        return self.at(self.newest(self.STATE_HZ, self.arm.now()))

    def get_frame(self):
        imaged_at = self.newest(self.CAMERA_HZ, self.arm.now() - self.LATE_S)
        state = self.newest(self.STATE_HZ, imaged_at)
        stamps = {"front": imaged_at + self.LATE_S, "state": state}
        image = np.full((24, 32, 3), int(imaged_at * self.CAMERA_HZ) % 256, np.uint8)
        return RobotFrame(self.at(state), {"front": image}, stamps)

    def send_action(self, action):
        self.arm.send_action(action)
        self.moved.append((self.arm.now(), self.arm.state))

    def stop(self):
        return None

    def close(self):
        return None


@pytest.fixture
def streams(bench):
    """The recording of a robot whose streams have rates of their own, and that is looked at less
    often than by those who replay it."""
    bench.policy = Looker(bench.arm.embodiment)
    bench.policy.action_rate_hz = 50.0
    bench.run(
        record=str(bench.work_dir / "rec"), operator=Streams(bench.arm), max_publish_step=70,
        chunk_joining="latest_only", simulated_latency=0.05, execute_horizon=4,
    )  # fmt: skip
    return str(bench.work_dir / "rec" / "001-1")


def test_streams_of_their_own_rates_never_run_backwards_in_a_replay(streams):
    recorded, operator = open_recording(streams), ReplayOperator(streams)
    looks = recorded.of("observation")
    gate = FreshnessGate(
        max(e["t"] - min(e["stamps"].values()) for e in looks) + 1e-6,
        max(abs(e["stamps"]["front"] - e["stamps"]["state"]) for e in looks) + 1e-6,
    )
    operator.connect()
    operator.begin_episode(recorded.instruction, 0)
    begins = looks[0]["t"]
    times = sorted([*np.arange(begins, looks[-1]["t"] + 0.1, 0.003), *(e["t"] for e in looks)])
    shown = {}
    for now in times:
        operator.clock.advance(now - operator.clock.now())
        shown[now] = operator.get_frame()
        gate.check(shown[now].stamps, ["front"], operator.clock.now())

    assert len(looks) > 5
    for event in looks:
        frame = shown[event["t"]]
        assert frame.stamps == pytest.approx(event["stamps"], abs=1e-9)
        np.testing.assert_array_equal(frame.state, event["state"])
        place = recorded.images["front"].newest(event["stamps"]["front"])
        np.testing.assert_array_equal(frame.images["front"], recorded.images["front"].read(place))


@pytest.mark.parametrize("joining", METHODS)
def test_streams_of_their_own_rates_are_replayed_with_every_joiner(bench, streams, joining):
    ask = bench.policy.predict_action
    bench.policy.continue_action = lambda observation, rest: ask(observation)
    table = {"type": "ReplayOperator", "recording": streams}
    bench.run(operator=table, max_publish_step=1000, chunk_joining=joining)

    assert bench.episode()["outcome"] == "done"


def test_an_image_that_was_not_recorded_in_time_does_not_end_a_replay(streams):
    operator = ReplayOperator(streams)
    images = operator.recorded.images["front"]
    first = images.read(1)
    # As where the disk was too slow for the very first one.
    del images.times[0], images._places[0]
    operator.connect()
    np.testing.assert_array_equal(operator.get_frame().images["front"], first)


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


@pytest.fixture(params=METHODS)
def joined(request, bench):
    """A recording made with one of the joiners."""
    policy = bench.policy
    policy.continue_action = lambda observation, rest: policy.predict_action(observation)
    bench.arm.get_state = lambda: bench.arm.state
    root = str(bench.work_dir / "rec")
    bench.run(record=root, max_publish_step=40, chunk_joining=request.param)
    return request.param, f"{root}/001-1"


def test_every_joiner_repeats_the_recorded_commands_whatever_its_horizon(bench, make_arm, joined):
    _, path = joined
    _, wanted = open_recording(path).commands("run")
    table = {"type": "ReplayPolicy", "recording": path, "actions": "commands"}
    for method in METHODS:
        for settings in ({}, {"execute_horizon": 3, "action_chunk": 4}):
            bench.arm = make_arm()
            bench.run(
                policy=table, chunk_joining=method, max_publish_step=1000, record_fps=None,
                **settings,
            )  # fmt: skip

            # The hold at the end may add commands: the last one again.
            sent = np.array(bench.arm.sent)
            np.testing.assert_allclose(sent[: len(wanted)], wanted, rtol=0, atol=1e-9)


def test_every_joiner_plays_the_last_recorded_answer_to_its_end(bench, make_arm, joined):
    recorded_with, path = joined
    first = open_recording(path)
    (_, wanted), chunks = first.commands("run"), first.chunks()
    for method in METHODS:
        bench.arm = make_arm()
        table = {"type": "ReplayPolicy", "recording": path}
        bench.run(
            record=str(bench.work_dir / method), policy=table, chunk_joining=method,
            max_publish_step=1000,
        )  # fmt: skip

        again = open_recording(bench.work_dir / method / "001-1")
        _, sent = again.commands("run")
        assert again.summary()["outcome"] == "recording_ended"
        assert len(again.chunks()) == len(chunks)
        # Where answers are left early the arm is late behind them, by its limits.
        last = [row for row in again.of("command") if row["phase"] == "run"][-1]
        np.testing.assert_allclose(last["wanted"], chunks[-1][-1], rtol=0, atol=1e-9)
        if method == recorded_with:
            np.testing.assert_array_equal(sent[: len(wanted)], wanted)


@pytest.mark.realtime
@pytest.mark.parametrize("method", ["latest_only", "rtc"])
def test_on_a_robot_the_recorded_commands_are_sent_to_the_last(bench, path, make_arm, method):
    table = {"type": "ReplayPolicy", "recording": path, "actions": "commands"}
    for attempt in range(3):
        bench.arm = make_arm(realtime=True)
        first, second = again(
            bench, path, f"rec-{attempt}", policy=table, chunk_joining=method,
            max_publish_step=1000,
        )  # fmt: skip
        times, sent = second.commands("run")
        # A machine that stands still leaves commands out, the last ones among them.
        if np.diff(times).max() < 0.05:
            break

    # Of the beginning, what was over when the policy had answered is left out.
    np.testing.assert_allclose(sent[-1], first.commands("run")[1][-1], rtol=0, atol=1e-6)
    assert second.summary()["outcome"] == "recording_ended"


def test_lines_of_json_are_enough_for_a_policy(bench, make_arm):
    bench.run(max_publish_step=20)
    path = str(bench.work_dir / "inference" / "001-1")
    sent = bench.arm.sent
    bench.arm = make_arm()
    bench.run(max_publish_step=20, policy=ReplayPolicy(path))

    np.testing.assert_array_equal(bench.arm.sent, sent)
    with pytest.raises(DataError, match="has no images: its robot cannot be replayed") as caught:
        bench.run(operator=ReplayOperator(path))
    assert "record again with --record DIR" in str(caught.value)


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
    with pytest.raises(DataError, match="no images"):
        ReplayOperator(str(bench.work_dir / "rec")).embodiment  # noqa: B018
