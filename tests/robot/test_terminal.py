"""A person at a terminal gives tasks to an arm, in a process of its own."""

from __future__ import annotations

import json

import pytest

from tests.robot.swinging import Swinging

pytestmark = pytest.mark.realtime
QUESTION = "task id or instruction (empty ends):"


@pytest.fixture
def swinging(tmp_path):
    made = Swinging(tmp_path, words=(), steps=25, terminal=True)
    yield made
    made.process.kill()
    made.process.wait()


def test_tasks_are_typed_one_after_the_other_and_ctrl_d_ends(swinging):
    assert "  1: swing to and fro" in swinging.hears(QUESTION)
    assert [note.partition(" ")[0] for note in swinging.notes()] == ["connect"]
    swinging.type(b"one\n")
    assert "unknown task 'one'; nothing was moved" in swinging.hears(QUESTION)
    swinging.type(b"1\n")
    swinging.hears(QUESTION)
    sent = [note for note in swinging.notes() if note.startswith("send")]
    swinging.wait_for("send", len(sent) + 20)
    swinging.type(b"swing a little slower\n")
    assert "the nearest is 1: 'swing to and fro'" in swinging.hears(QUESTION)
    swinging.type(b"swing to and fro\n")
    swinging.hears(QUESTION)
    swinging.type(b"\x04")

    returned, output = swinging.end()

    assert returned == 0, output
    assert "episodes: 2" in output
    assert swinging.notes()[-2:] == ["stop", "close"]
    # Held in between: the last command again and again.
    held = [note for note in swinging.notes() if note.startswith("send")][len(sent) :][:20]
    assert held == [sent[-1]] * 20
    episode = swinging.work_dir / "inference" / "002-1" / "episode.json"
    assert json.loads(episode.read_text())["outcome"] == "max_steps"


@pytest.mark.parametrize("while_held", [False, True])
def test_ctrl_c_at_the_question_ends_in_a_stop(swinging, while_held):
    swinging.hears(QUESTION)
    if while_held:
        swinging.type(b"1\n")
        swinging.hears(QUESTION)
    swinging.type(b"\x03")

    returned, output = swinging.end()

    assert returned == 130, output
    assert "interrupted: stopped by Ctrl-C; the robot was stopped" in output
    assert "Traceback" not in output
    assert swinging.notes()[-2:] == ["stop", "close"]


def test_a_terminal_that_goes_away_stops_the_arm(tmp_path):
    """The network of whoever is logged in fails while the arm moves."""
    swinging = Swinging(tmp_path, terminal=True)
    swinging.wait_for("send", 40)
    swinging.hang_up()

    returned, output = swinging.end()

    assert returned == 1, output
    assert "stopped by SIGHUP; the robot was stopped" in output
    assert swinging.notes()[-3:] == ["stop", "stop", "close"]
    episode = json.loads((swinging.work_dir / "inference" / "001-1" / "episode.json").read_text())
    assert (episode["outcome"], episode["problem"]) == ("interrupted", "stopped by SIGHUP")
