"""What goes wrong with ``fluxvla run`` and its control process, seen from the other side of DDS.

What a fault is, and how it is provoked, is in ``benchmarks/_process_faults.py``; ``play`` holds
every command that was received against the limits, and sees that no process is left.
"""

from __future__ import annotations

import json
import os
import re
import signal
import time
from contextlib import suppress
from importlib.util import find_spec

import numpy as np
import pytest

from benchmarks._process_faults import (
    CYCLONE_FAULT,
    PREFIX,
    PROCESS_FAULTS,
    patient,
    play,
)
from benchmarks._process_program import PROVOKED, SENT
from benchmarks._robot_faults import GOES_ON, MOVING, NAMES, STOP, stage_crew
from benchmarks._terminal_program import END_S, START_S, program
from fluxvla_core.robot.recording.recorded import open_recording

pytestmark = pytest.mark.realtime
OWN_ARM = """
import benchmarks._process_program as program
from fluxvla_core.plugins.registry import OPERATORS

OPERATORS.unregister("ProgramArm")


@OPERATORS.register_module()
class ProgramArm(program.ProgramArm):
    pass
"""
QUESTION = "task id or instruction (empty ends):"


@pytest.fixture(scope="module")
def stage(ros_domain):
    with stage_crew() as make:
        yield make


def of(outcome):
    faults = [fault for fault in PROCESS_FAULTS if fault.outcome == outcome]
    return [pytest.param(fault, id=fault.name.removeprefix(PREFIX)) for fault in faults]


def provoked(stage, folder, fault):
    for attempt in range(fault.attempts):
        result = play(stage(folder / str(attempt)), fault)
        if result.provoked:
            return result
    pytest.fail(f"{fault.attempts} times it ended before the fault was there: {result.said}")


@pytest.mark.parametrize("fault", of(STOP))
def test_the_arm_is_stopped_and_the_cause_is_named(stage, tmp_path, fault):
    result = provoked(stage, tmp_path, fault)

    assert fault.matches(result.said), f"{result.said!r} does not say {fault.says!r}"
    assert result.exit_code == fault.exit_code
    assert result.hold_s is not None
    if fault.exit_code < 0:
        # The control process may complete a record, of whatever it knows.
        return
    assert result.record["outcome"] == ("interrupted" if fault.interrupts else "failed")
    rules = [trip["rule"] for trip in result.record["trips"]]
    assert rules == ([] if fault.interrupts else [fault.rule])
    assert fault.interrupts or result.record["problem"].strip() in result.said


@pytest.mark.slow
@pytest.mark.skipif(find_spec("cyclonedds") is None, reason="no wheel of Cyclone DDS")
def test_the_arm_is_held_while_images_from_another_dds_freeze_the_main_process(tmp_path):
    with stage_crew(CYCLONE_FAULT.environment) as own_stage:
        result = provoked(own_stage, tmp_path, CYCLONE_FAULT)

    assert CYCLONE_FAULT.matches(result.said), result.said
    assert result.exit_code == CYCLONE_FAULT.exit_code
    assert result.hold_s is not None


@pytest.mark.parametrize("fault", of(GOES_ON))
def test_the_run_goes_on(stage, tmp_path, fault):
    result = provoked(stage, tmp_path, fault)

    assert (result.said, result.exit_code) == ("", 0)
    assert (result.record["outcome"], result.record["trips"]) == ("max_steps", [])
    assert len(result.commands) >= result.record["steps"]


def test_a_signal_stops_the_arm_after_a_stop_that_was_rearmed(stage, tmp_path):
    """What ended one episode says nothing of the next."""
    made = stage(tmp_path)
    with patient(made), program(made, words=()) as running:

        def asked():
            return running.said.count(QUESTION) > answered

        def moving():
            return len(made.commands()) >= before + MOVING

        for answered, line in enumerate(("1", "rearm", "1")):
            running.wait_for(asked, "the question", START_S)
            before = len(made.commands())
            running.type(f"{line}\n")
            if line == "1":
                running.wait_for(moving, "the first command", START_S)
                if answered == 0:
                    running.order("fail")
        running.type("\x03")
        running.wait_for(lambda: False, "the end", END_S)
    assert running.process.returncode == 130, running.said
    assert "the policy raised ValueError: no answer" in running.said


def test_a_paused_control_process_keeps_nobody_from_ending_the_run(stage, tmp_path):
    """Before the first command nothing is urgent, until somebody presses Ctrl-C."""
    made = stage(tmp_path)
    with program(made) as running:
        running.order("think")
        running.wait_for((tmp_path / PROVOKED).exists, "the first question", START_S)
        os.kill(running.control, signal.SIGSTOP)
        running.type("\x03")
        running.wait_for(lambda: False, "the end", END_S)
        left = running.processes()
    assert (running.process.returncode, left) == (1, []), running.said
    assert re.search(r"the control process did not run for \d+\.\d s and was killed", running.said)
    assert not made.commands()


def test_the_record_of_a_paused_main_process_has_every_command(stage, tmp_path):
    made = stage(tmp_path)
    (fault,) = (f for f in PROCESS_FAULTS if "main process paused" in f.name)
    result = play(made, fault)

    (trace,) = (tmp_path / "inference").glob("*/trace.jsonl")
    lines = [json.loads(line) for line in trace.read_text().splitlines()]
    recorded = [line["command"] for line in lines if line["event"] == "command"]
    sent = np.fromfile(tmp_path / SENT).reshape(-1, len(NAMES))
    # After these, the operator's own stop.
    assert len(recorded) >= result.record["steps"]
    np.testing.assert_allclose(recorded, sent[: len(recorded)])
    assert (sent[len(recorded) :] == recorded[-1]).all()


def test_a_main_process_that_is_killed_after_it_was_frozen(stage, tmp_path):
    """Nobody else can say then why the arm stopped, nor complete the record."""
    made = stage(tmp_path)
    with program(made) as running:
        running.wait_for(lambda: len(made.commands()) >= MOVING, "the first command", START_S)
        running.process.send_signal(signal.SIGSTOP)
        running.wait_for(running.at_rest, "coming to rest", END_S)
        running.process.kill()
        running.process.wait()
        until = time.monotonic() + END_S
        while running.processes():
            assert time.monotonic() < until, running.said
            time.sleep(0.01)
        said = running.said
    silent = r"the main process did not run for \d+\.\d+ s, safety.silence_s is 0\.2"
    assert re.search(rf"was killed \(before that: {silent}\); the robot was stopped", said), said
    (folder,) = (tmp_path / "inference").glob("*")
    recorded = open_recording(folder)
    assert recorded.finished
    assert recorded.summary()["trips"][0]["rule"] == "main process"
    sent = np.fromfile(tmp_path / SENT).reshape(-1, len(NAMES))
    _, found = recorded.commands()
    np.testing.assert_allclose(found, sent[: len(found)])
    assert (sent[len(found) :] == found[-1]).all()


def test_a_machine_that_stands_still_is_no_hung_control_process(stage, tmp_path):
    """The main process may go on first: what it killed then could have held the arm."""
    made = stage(tmp_path)
    with program(made) as running:
        running.wait_for(lambda: len(made.commands()) >= MOVING, "the first command", START_S)
        control = running.control
        os.kill(control, signal.SIGSTOP)
        running.process.send_signal(signal.SIGSTOP)
        time.sleep(2.0)
        running.process.send_signal(signal.SIGCONT)
        time.sleep(0.3)
        os.kill(control, signal.SIGCONT)
        time.sleep(1.0)
        with suppress(OSError):  # it has ended
            running.type("\x03")
        running.wait_for(lambda: False, "the end", END_S)
        said = running.said
    assert "nothing commands the robot any more" not in said
    # The state was too old for a moment, the main process was silent, or nothing was wrong until
    # Ctrl-C. Where something was, Ctrl-C may find Python ending, where SIGINT ends it at once.
    over = re.search("is silent for|main process did not run for", said)
    ended = [1, 130] + ([-signal.SIGINT] if over else [])
    assert running.process.returncode in ended, said


def test_an_arm_of_a_plugin_file(stage, tmp_path):
    """What another process imports is the file itself."""
    made = stage(tmp_path)
    with program(made, steps=MOVING, plugin=OWN_ARM) as running:
        running.wait_for(lambda: False, "the end", START_S)
    assert running.process.returncode == 0, running.said
    assert len(made.commands()) >= MOVING
