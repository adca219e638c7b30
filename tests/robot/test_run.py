"""Episodes that go well: what the robot gets, what the policy is asked, what is recorded."""

from __future__ import annotations

import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from fluxvla_core.control.filters import LowPass
from fluxvla_core.errors import ConfigError, FluxError, UsageError


def test_an_episode_runs_to_its_bound_and_ends_in_hold(bench):
    result = bench.run()

    assert result == {
        "episodes": 1,
        "task": "1",
        "outcome": "max_steps",
        "success": False,
        "steps": 60,
    }
    assert bench.arm.calls == ["connect", "stop", "close"]
    np.testing.assert_array_equal(bench.arm.sent[-1], bench.arm.sent[-2])
    assert bench.arm.state[0] == pytest.approx(0.8)
    bench.assert_within_limits()


def test_an_episode_cut_in_full_motion_still_brakes_within_limits(bench):
    bench.policy.goal, bench.policy.stride = 1.4, 0.15

    bench.run(max_publish_step=23)

    assert len(bench.arm.sent) > 23
    bench.assert_within_limits()
    assert [row["phase"] for row in bench.trace() if row["event"] == "command"][-1] == "hold"
    np.testing.assert_allclose(bench.arm.sent[-1], bench.arm.sent[-2], atol=1e-3)


def test_the_policy_hears_the_tasks_words_and_sees_the_images(bench):
    bench.run(task="2")

    asked = bench.policy.asked[0]
    assert asked["task_description"] == "lift the red cube"
    assert asked["qpos"].dtype == np.float32
    assert asked["images"]["front"].shape == (24, 32, 3)


def test_an_instruction_in_words_is_passed_on(bench):
    with pytest.raises(UsageError, match="unknown task 'stir the soup'"):
        bench.run(task="stir the  soup")
    assert bench.arm.calls == bench.arm.sent == []
    bench.run(task="stir the  soup", free_tasks=True)

    (said,) = [line for line in bench.notes.lines if "stir the soup" in line and "warn" in line]
    assert "not known to be trained on it" in said
    assert bench.policy.asked[0]["task_description"] == "stir the soup"
    assert bench.episode("001-stir-the-soup")["instruction"] == "stir the soup"


def test_the_horizon_says_after_how_many_actions_the_policy_is_asked_again(bench):
    bench.run(execute_horizon=2, max_publish_step=50)
    # 50 commands at 50 Hz are 10 actions at 10 Hz.
    assert len(bench.policy.asked) == 5


def test_an_action_chunk_of_one_uses_one_action(bench):
    bench.run(action_chunk=1, max_publish_step=20)

    assert len(bench.policy.asked) == 4


def test_an_episode_ends_when_the_robot_says_that_it_is_done(bench):
    bench.arm.goal = 0.3

    result = bench.run()

    assert (result["outcome"], result["success"]) == ("done", True)
    assert result["steps"] < 60
    assert bench.episode()["success"] is True


def test_the_arm_goes_to_the_start_pose_first(bench):
    bench.run(prepare_pose=[-0.5, 1.0, 1.0])

    ramp = [row for row in bench.trace() if row["event"] == "command" and row["phase"] == "ramp"]
    assert ramp[-1]["command"] == [-0.5, 1.0, 1.0]
    assert bench.policy.asked[0]["qpos"] == pytest.approx([-0.5, 1.0, 1.0])
    # All joints arrive together, at a quarter of the speed limit at most.
    path = np.array([row["command"] for row in ramp])
    share = (path - np.array([0.0, 0.0, 0.5])) / np.array([-0.5, 1.0, 0.5])
    np.testing.assert_allclose(share, share[:, :1].repeat(3, axis=1), atol=1e-9)
    assert np.abs(np.diff(path[:, 0]) * 50).max() <= 0.25 * 2.0
    assert any("moving to the start pose" in line for line in bench.notes.lines)
    bench.assert_within_limits()


def test_an_arm_that_is_let_go_on_its_way_to_the_start_pose_stays_slow(bench, make_arm):
    class Slowed(make_arm):
        @property
        def speed_scaling(self):
            return 0.05 if len(self.sent) < 100 else 1.0

    bench.arm = Slowed()
    bench.run(prepare_pose=[-0.9, 1.5, 0.9])

    ramp = [r["command"] for r in bench.trace() if r.get("phase") == "ramp"]
    assert len(ramp) > 150
    assert ramp[-1] == [-0.9, 1.5, 0.9]
    pace = np.abs(np.diff(ramp, axis=0)).max(axis=0) * 50
    fastest = np.array([joint.velocity for joint in bench.arm.embodiment.joints])
    assert (pace <= 0.25 * fastest).all()
    bench.assert_within_limits()


def test_an_episode_is_recorded_line_by_line(bench):
    bench.run()

    trace, summary = bench.trace(), bench.episode()
    commands = [row for row in trace if row["event"] == "command"]
    chunks = [row for row in trace if row["event"] == "chunk"]
    assert len(commands) == len(bench.arm.sent)
    np.testing.assert_array_equal([row["command"] for row in commands], bench.arm.sent)
    assert len(chunks) == summary["chunks"] == len(bench.policy.asked)
    assert set(chunks[0]["ms"]) == {"policy"}
    assert commands[0].keys() == {
        "event", "t", "phase", "wanted", "command", "state", "clamps", "ms",
    }  # fmt: skip
    assert set(summary["timings"]) == {"receipt", "sync", "policy", "late", "send"}
    assert summary["timings"]["send"].keys() == {"count", "p50_ms", "p95_ms", "p99_ms", "max_ms"}
    assert summary["joints"] == ["shoulder", "elbow", "jaw"]
    assert (summary["seed"], summary["trips"], summary["problem"]) == (7, [], None)
    assert bench.notes.artifacts == [("episode", bench.work_dir / "inference" / "001-1")]


def test_every_clamp_is_in_the_record(bench):
    bench.policy.goal, bench.policy.stride = 1.4, 0.35

    bench.run()

    rows = [row for row in bench.trace() if row["event"] == "command" and row["clamps"]]
    clamp = rows[0]["clamps"][0]
    assert clamp["joint"] == "shoulder"
    assert clamp["given"] == rows[0]["command"][0] != clamp["wanted"] == rows[0]["wanted"][0]
    count = sum(len(row["clamps"]) for row in rows)
    assert sum(sum(r.values()) for r in bench.episode()["clamps"].values()) == count
    bench.assert_within_limits()


def test_images_become_a_video_for_each_camera(bench):
    av = pytest.importorskip("av")

    bench.run(record_fps=10)

    with av.open(str(bench.work_dir / "inference" / "001-1" / "front.mp4")) as video:
        frames = sum(1 for _ in video.decode(video=0))
    assert frames == len(bench.arm.sent) // 5


def test_an_episode_can_be_repeated_and_its_seed_is_the_runs(bench, make_arm):
    bench.run(seed=11)
    first = bench.arm.sent
    bench.arm = make_arm()
    bench.run(seed=11)

    np.testing.assert_array_equal(first, bench.arm.sent)
    assert bench.policy.seeds == [11, 11]
    assert bench.episode("002-1")["seed"] == 11


def test_action_filters_come_in_their_order_before_the_limits(bench):
    seen = []

    def double(action):
        seen.append(action.copy())
        return action * 2

    def spy(action):
        seen.append(action.copy())
        return action

    bench.run(action_filters=[double, spy], max_publish_step=10)

    np.testing.assert_array_equal(seen[1], seen[0] * 2)
    bench.assert_within_limits()


def test_a_filter_is_told_where_an_episode_begins(bench):
    start = -0.5
    low_pass = LowPass(0.1, joints=["shoulder"])
    bench.run(action_filters=[low_pass], max_publish_step=5, prepare_pose=[start, 0.0, 0.5])

    (first, *_) = [row for row in bench.trace() if row.get("phase") == "run"]
    # From the start pose, not from where the arm was before it went there.
    smooth = start + 0.1 * (first["wanted"][0] - start)
    assert first["command"][0] == pytest.approx(smooth, abs=1e-5)


def test_filters_are_built_from_tables_in_the_config(bench):
    tables = [
        {"type": "LowPass", "share": 0.5},
        {"type": "SnapGripper", "threshold": 1.1},
    ]

    bench.run(action_filters=tables)

    assert bench.arm.sent[-1][2] == 0.0


def test_nearly_closed_grippers_are_closed_if_asked_for(bench, make_arm):
    def nearly(chunk):
        chunk[:, 2] = 0.04
        return chunk

    for threshold, ends_at in ((None, 0.04), (0.05, 0.0)):
        bench.arm = make_arm()
        bench.policy.faults = dict.fromkeys(range(1, 99), nearly)
        bench.run(gripper_threshold=threshold)
        assert bench.arm.sent[-1][2] == ends_at


def test_a_filter_that_does_not_fit_the_robot_is_said_before_it_is_connected(bench):
    with pytest.raises(ConfigError, match="LowPass: there is no joint 'jow'"):
        bench.run(action_filters=[{"type": "LowPass", "share": 0.5, "joints": ["jow"]}])
    assert bench.arm.calls == []


def test_an_operator_that_wants_to_know_is_told_about_each_episode(bench):
    told = []
    bench.arm.begin_episode = lambda instruction, episode: told.append((instruction, episode))

    bench.run()

    assert told == [("wave at the camera", 0)]


def test_a_state_that_can_be_read_alone_is_read_at_every_command(bench):
    bench.arm.get_state = lambda: bench.arm.state + 0.001

    bench.run(max_publish_step=10)

    row = bench.trace()[3]
    np.testing.assert_allclose(row["state"], np.array(row["command"]) + 0.001)


class Recorder:
    """A hook that takes everything down."""

    def __init__(self):
        self.calls, self.sent = [], []

    def run_started(self, embodiment):
        self.embodiment = embodiment

    def episode_started(self, task):
        self.calls.append(("episode_started", task))

    def observed(self, observation):
        self.calls.append(("observed", observation["images"]["front"].flags.writeable))

    def inferred(self, chunk, latency_s):
        self.calls.append(("inferred", chunk.shape, chunk.flags.writeable))

    def action_sent(self, action, stamp, target, state):
        writeable = action.flags.writeable or target.flags.writeable
        self.calls.append(("action_sent", writeable))
        self.sent.append((stamp, action, target, state))

    def stopped(self, rule, problem):
        self.calls.append(("stopped", rule, problem))

    def episode_finished(self, reason):
        self.calls.append(("episode_finished", reason))

    def run_finished(self, outcome):
        self.calls.append(("run_finished", outcome))


def test_hooks_watch_and_cannot_touch(bench, monkeypatch):
    from fluxvla_core.hooks import HookCaller

    hook = Recorder()
    monkeypatch.setattr(
        "fluxvla_core.robot.runner.build_hooks",
        lambda context: HookCaller(context, [("Recorder", hook)]),
    )

    bench.run(max_publish_step=5)

    assert hook.calls == [
        ("episode_started", "wave at the camera"),
        ("observed", False),
        ("inferred", (5, 3), False),
        *[("action_sent", False)] * (len(bench.arm.sent)),
        ("episode_finished", "max_steps"),
        ("run_finished", "ok"),
    ]
    assert hook.embodiment == bench.arm.embodiment
    stamps, actions, targets, _ = zip(*hook.sent, strict=True)
    assert list(stamps) == sorted(stamps)
    np.testing.assert_array_equal(actions, bench.arm.sent)
    assert {target.shape for target in targets} == {(3,)}


def test_hooks_are_told_of_a_stop(bench, monkeypatch):
    from fluxvla_core.hooks import HookCaller

    hook = Recorder()
    monkeypatch.setattr(
        "fluxvla_core.robot.runner.build_hooks",
        lambda context: HookCaller(context, [("Recorder", hook)]),
    )

    def fail(chunk):
        raise ValueError("no idea")

    bench.policy.faults[2] = fail
    with pytest.raises(FluxError, match="no idea"):
        bench.run(max_publish_step=50)

    (stopped,) = [call for call in hook.calls if call[0] == "stopped"]
    assert stopped[1] == "policy"
    assert "no idea" in stopped[2]
    assert hook.calls[-1] == ("run_finished", "failed")


@pytest.mark.parametrize("asynchronous", [False, True])
@pytest.mark.realtime
def test_on_a_robot_all_readings_are_made_in_one_thread_and_all_commands_in_another(
    bench, make_arm, asynchronous
):
    bench.arm = make_arm(realtime=True)
    reading, sending = set(), set()
    get_frame, send_action = bench.arm.get_frame, bench.arm.send_action

    def read():
        reading.add(threading.current_thread())
        return get_frame()

    def send(action):
        sending.add(threading.current_thread())
        send_action(action)

    bench.arm.get_frame, bench.arm.send_action = read, send

    bench.run(max_publish_step=40, async_execution=asynchronous, record_fps=None)

    assert len(reading) == 1
    assert sending == {threading.main_thread()}
    bench.assert_within_limits()


@pytest.mark.realtime
def test_while_it_moves_the_policy_is_asked_again_and_again(bench, make_arm):
    bench.arm = make_arm(realtime=True)

    bench.run(max_publish_step=50, async_execution=True)

    assert len(bench.policy.asked) > 10
    assert bench.arm.state[0] > 0.3


def test_nothing_heavy_is_imported_to_drive_a_robot():
    code = (
        "import sys, fluxvla_core.robot.runner, fluxvla_core.robot.recording.trace;"
        "print([m for m in ('torch', 'cv2', 'av', 'pyarrow', 'rich') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert done.stdout.strip() == "[]"


@pytest.mark.realtime
def test_while_the_policy_warms_up_the_arm_is_held_at_the_start_pose(bench, make_arm):
    """Some drivers stop an arm that they hear nothing for."""
    bench.arm = make_arm(realtime=True)

    def warm_up(chunk):
        time.sleep(1.5)
        return chunk

    bench.policy.faults[1] = warm_up

    result = bench.run(prepare_pose=[0.05, 0.0, 0.5], max_publish_step=10)

    assert result["steps"] == 10, "what is sent meanwhile is none of the episode's commands"
    ready = [row["command"] for row in bench.trace() if row.get("phase") == "ready"]
    assert len(ready) >= 10
    np.testing.assert_array_equal(ready, [[0.05, 0.0, 0.5]] * len(ready))
    bench.assert_within_limits()


@pytest.mark.realtime
def test_without_a_start_pose_nothing_is_sent_before_the_first_chunk(bench, make_arm):
    bench.arm = make_arm(realtime=True)
    sent = []
    predict = bench.policy.predict_action

    def slow(observation):
        time.sleep(0.2)
        sent.append(len(bench.arm.sent))
        return predict(observation)

    bench.policy.predict_action = slow
    bench.run(max_publish_step=10)

    assert sent[:2] == [0, 0]
