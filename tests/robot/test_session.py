"""Several tasks in one run: what the arm does between them, and after a stop."""

from __future__ import annotations

import json
import os
import signal
import time

import numpy as np
import pytest

from fluxvla_core.errors import Faulted, NotReady, RunFailed, SafetyStop, UsageError
from tests.robot.faults import nan
from tests.robot.test_sources import Person, Slow


def test_a_file_of_tasks_is_done_from_the_first_to_the_last(bench, tmp_path):
    file = tmp_path / "tasks.txt"
    file.write_text("2\nstir the soup\n1\n")

    result = bench.run(task=None, task_file=str(file), max_publish_step=10, free_tasks=True)

    assert (result["episodes"], result["task"]) == (3, "1")
    instructions = [asked["task_description"] for asked in bench.policy.asked]
    assert list(dict.fromkeys(instructions)) == [
        "lift the red cube",
        "stir the soup",
        "wave at the camera",
    ]
    assert bench.policy.seeds == [7, 8, 9]
    assert bench.arm.calls == ["connect", "stop", "close"]


def test_a_slip_in_the_file_is_said_before_anything_is_connected(bench, tmp_path):
    file = tmp_path / "tasks.txt"
    file.write_text("1\nwvae\n")

    with pytest.raises(UsageError, match=r"tasks\.txt:2: unknown task 'wvae'; nothing was moved"):
        bench.run(task=None, task_file=str(file))
    assert bench.arm.calls == []


def test_a_failed_task_is_the_last_of_its_file(bench, tmp_path):
    file = tmp_path / "tasks.txt"
    file.write_text("1\n2\n")
    bench.policy.faults[1] = nan

    with pytest.raises(SafetyStop, match="not finite"):
        bench.run(task=None, task_file=str(file))
    assert len(bench.policy.asked) == 1


def test_a_person_gives_one_task_after_the_other(bench, asked):
    person = asked(Person("2", "nonsense", "1"))

    result = bench.run(task=None, max_publish_step=5)

    assert result["episodes"] == 2
    assert [bench.episode(n)["instruction"] for n in ("001-2", "002-1")] == [
        "lift the red cube",
        "wave at the camera",
    ]
    first, unknown, *_ = person.told
    assert first == "2: max_steps, no success, 5 commands"
    assert "unknown task 'nonsense'" in unknown


def test_a_simulation_whose_time_stands_still_stands_still_between_tasks(bench, asked):
    asked(Slow("1", "2"))

    bench.run(task=None, max_publish_step=5)

    steps = sum(len([r for r in bench.trace(n) if r["event"] == "command"])
                for n in ("001-1", "002-2"))  # fmt: skip
    assert len(bench.arm.sent) == steps


@pytest.mark.realtime
def test_between_two_tasks_the_last_command_is_sent_again_at_every_beat(bench, make_arm, asked):
    bench.arm = make_arm(realtime=True)
    asked(Slow("1", "2", polls=30))

    bench.run(task=None, max_publish_step=10)

    ended = len([row for row in bench.trace("001-1") if row["event"] == "command"])
    held = bench.arm.sent[ended : ended + 30]
    assert len(held) == 30
    np.testing.assert_array_equal(held, [bench.arm.sent[ended - 1]] * 30)
    bench.assert_within_limits()


@pytest.mark.realtime
def test_nothing_is_sent_before_the_first_task(bench, make_arm, asked):
    bench.arm = make_arm(realtime=True)
    sent = []

    class Watcher(Slow):
        def poll(self):
            sent.append(len(bench.arm.sent))
            return super().poll()

    asked(Watcher("1"))
    bench.run(task=None, max_publish_step=5)

    assert sent[:11] == [0] * 11


@pytest.mark.realtime
def test_an_arm_that_fails_while_it_is_held_stops_the_run(bench, make_arm, asked):
    bench.arm = make_arm(realtime=True)
    asked(Slow("1", "2", polls=60))
    bench.arm.faults = {"send_action": OSError("cable pulled"), "after": 25}

    with pytest.raises(Faulted, match=r"Arm\.send_action raised OSError: cable pulled"):
        bench.run(task=None, max_publish_step=10)
    assert bench.arm.calls[-2:] == ["stop", "close"]
    assert bench.episode("001-1")["outcome"] == "max_steps"


@pytest.mark.realtime
def test_what_stops_an_arm_between_two_tasks_is_recorded_with_the_one_before(
    bench, make_arm, asked
):
    bench.arm = make_arm(realtime=True)
    asked(Slow("1", "2", polls=60))
    bench.arm.faults = {"send_action": OSError("cable pulled"), "after": 25}
    stop = bench.arm.stop
    bench.arm.stop = lambda: (stop(), 1 / 0)

    with pytest.raises(Faulted, match="cable pulled"):
        bench.run(task=None, max_publish_step=10)
    (line,) = (bench.work_dir / "inference" / "001-1" / "held.jsonl").read_text().splitlines()
    found = json.loads(line)
    assert found["rule"] == "operator"
    assert found["what"] == "Arm.send_action raised OSError: cable pulled"
    assert found["failure"] == "Arm.stop raised ZeroDivisionError: division by zero"
    assert time.time() - found["time"] < 600
    assert bench.episode("001-1")["trips"] == []


@pytest.mark.realtime
def test_a_trip_that_cannot_be_recorded_is_said_and_stops_all_the_same(
    bench, make_arm, asked, monkeypatch
):
    monkeypatch.setattr("fluxvla_core.robot.recording.episode_log.HELD", "there/is/no/such/folder")
    bench.arm = make_arm(realtime=True)
    asked(Slow("1", "2", polls=60))
    bench.arm.faults = {"send_action": OSError("cable pulled"), "after": 25}

    with pytest.raises(Faulted, match="cable pulled"):
        bench.run(task=None, max_publish_step=10)
    assert any("a trip could not be recorded" in line for line in bench.notes.lines)
    assert bench.arm.calls[-2:] == ["stop", "close"]


@pytest.mark.realtime
def test_after_a_stop_nothing_moves_until_the_word_is_said(bench, make_arm, asked):
    bench.arm = make_arm(realtime=True)
    bench.policy.faults[2] = nan
    person = asked(Slow("1", "2", "rearm", "2", polls=5))

    result = bench.run(task=None, max_publish_step=10)

    assert (result["episodes"], result["task"]) == (1, "2")
    failure, refused, armed, outcome = person.told
    assert outcome == "2: max_steps, no success, 10 commands"
    assert "the policy's chunk is not finite" in failure
    assert "stopped; 'rearm' allows motion again" in failure
    assert "still stopped by rule chunk: the policy's chunk is not finite" in refused
    assert armed == "motion is allowed again"
    # Neither held nor moved meanwhile: what was sent is what the two episodes recorded.
    recorded = [
        row["command"]
        for name in ("001-1", "002-2")
        for row in bench.trace(name)
        if row["event"] == "command"
    ]
    np.testing.assert_array_equal(bench.arm.sent[: len(recorded)], recorded)
    assert bench.episode("001-1")["outcome"] == "failed"
    bench.assert_within_limits()


def test_a_run_that_ends_while_stopped_has_failed(bench, asked):
    bench.policy.faults[1] = nan
    person = asked(Person("1"))

    with pytest.raises(SafetyStop, match="ended while the robot was stopped by rule chunk") as hit:
        bench.run(task=None)
    # What stopped it was told when it happened, and is not said again.
    assert "not finite" not in str(hit.value)
    assert ["not finite" in text for text in person.told] == [True]


def test_saying_the_word_without_a_stop_changes_nothing(bench, asked):
    person = asked(Person("rearm", "1"))

    assert bench.run(task=None, max_publish_step=5)["episodes"] == 1
    assert person.told == ["nothing was stopped", "1: max_steps, no success, 5 commands"]


def test_a_robot_that_failed_ends_the_run_whoever_asks(bench, asked):
    asked(Person("1", "rearm", "1"))
    bench.arm.faults = {"send_action": OSError("cable pulled"), "after": 3}

    with pytest.raises(Faulted, match="cable pulled"):
        bench.run(task=None)
    assert bench.arm.calls[-1] == "close"


@pytest.mark.realtime
def test_a_policy_that_still_thinks_is_not_asked_again(bench, make_arm, asked, hang):
    bench.arm = make_arm(realtime=True)
    asked(Person("1", "rearm", "1"))
    # The fourth answer at the earliest is in motion: slow ones before it are asked for again.
    bench.policy.faults[4] = hang

    with pytest.raises(SafetyStop, match="waits for a chunk"):
        bench.run(task=None, max_publish_step=500, safety={"starvation_s": 0.5})


def test_a_policy_that_raised_may_be_asked_again(bench, asked):
    bench.policy.faults[1] = ValueError("out of memory")
    asked(Person("1", "rearm", "1"))

    assert bench.run(task=None, max_publish_step=5)["episodes"] == 1


def test_a_stream_that_fell_silent_may_come_back(bench, asked):
    silent = NotReady("camera front is silent")
    person = asked(Person("1", "rearm", "1"))
    bench.arm.faults = {"get_frame": silent, "after": 20}
    rearm = person.poll

    def mended():
        line = rearm()
        if line == "rearm":
            bench.arm.faults = {}
        return line

    person.poll = mended

    assert bench.run(task=None, max_publish_step=30)["episodes"] == 1
    assert "camera front is silent" in person.told[0]
    assert bench.arm.calls == ["connect", "stop", "stop", "close"]


class Impatient(Person):
    """Sends a signal instead of a line."""

    def __init__(self, *lines, number):
        super().__init__(*lines)
        self.number = number

    def poll(self):
        if not self.lines:
            os.kill(os.getpid(), self.number)
            return None
        return super().poll()


@pytest.mark.parametrize(
    ("number", "error", "said"),
    [
        (signal.SIGINT, KeyboardInterrupt, "stopped by Ctrl-C"),
        (signal.SIGTERM, RunFailed, "stopped by SIGTERM; the robot was stopped"),
        (signal.SIGHUP, RunFailed, "stopped by SIGHUP; the robot was stopped"),
    ],
)
@pytest.mark.parametrize("lines", [(), ("1",)], ids=["at once", "while held"])
@pytest.mark.realtime
def test_a_signal_while_nobody_moves_the_arm_ends_the_run(
    bench, make_arm, asked, lines, number, error, said
):
    bench.arm = make_arm(realtime=True)
    asked(Impatient(*lines, number=number))

    with pytest.raises(error, match=said):
        bench.run(task=None, max_publish_step=5)
    assert bench.arm.calls == ["connect", "stop", "close"]


def test_a_signal_during_a_stop_ends_a_run_that_would_have_gone_on(bench, asked):
    """Somebody presses Ctrl-C because the arm does something odd, as it has just been stopped."""
    bench.policy.faults[1] = nan
    bench.arm.faults = {"stop": lambda: os.kill(os.getpid(), signal.SIGINT)}
    asked(Person("1", "rearm", "1"))

    with pytest.raises(KeyboardInterrupt, match="stopped by Ctrl-C"):
        bench.run(task=None)
    assert len(bench.policy.asked) == 1


@pytest.mark.parametrize("times", [1, 2])
def test_signals_while_the_record_is_finished_wait_until_it_is_complete(bench, monkeypatch, times):
    from fluxvla_core.robot.recording.recorder import EpisodeRecorder

    close = EpisodeRecorder._finish

    def interrupted(self, *arguments, **named):
        for _ in range(times):
            os.kill(os.getpid(), signal.SIGINT)
        return close(self, *arguments, **named)

    monkeypatch.setattr(EpisodeRecorder, "_finish", interrupted)
    # However long the first has been waiting by then.
    monkeypatch.setattr("fluxvla_core.control.interrupt.IMPATIENT_S", 0.0)

    with pytest.raises(KeyboardInterrupt):
        bench.run(max_publish_step=5)
    assert bench.episode()["outcome"] == "max_steps"


def test_the_source_is_opened_before_the_robot_and_closed_after_it(bench, asked):
    class Listed(Person):
        def open(self):
            bench.arm.calls.append("source opened")

        def close(self):
            bench.arm.calls.append("source closed")

    asked(Listed())
    bench.run(task=None)

    assert bench.arm.calls == ["source opened", "connect", "stop", "close", "source closed"]
