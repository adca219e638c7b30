"""Nothing beyond a limit arrives from two processes either, whatever becomes of the main one.

The program (``adversarial_program``) asks for chunk after chunk that is no motion, in real time. At
a random moment its main process is paused, killed, or told to stop; a third process hears what the
control process sends, through DDS.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks._process_program import SENT
from benchmarks._robot_faults import COMMAND, SINKS, STATE, resting, with_overtaken
from fluxvla_core.ros2 import IMAGE, JOINT_STATE
from tests.ros2.adversarial import ARM, HOME, hold_against_limits
from tests.ros2.adversarial_program import CHUNKS
from tests.ros2.arm import wait_for

pytestmark = pytest.mark.realtime
ROOT = Path(__file__).resolve().parents[2]
PROGRAM = "from tests.ros2.adversarial_program import main; main()"
NAMES = list(ARM.joint_names)
STREAMS = [
    {
        "topic": STATE,
        "message": JOINT_STATE,
        "hz": 100,
        "names": NAMES,
        "positions": HOME.tolist(),
        "follows": COMMAND,
    },
    {"topic": "/front/image", "message": IMAGE, "hz": 30, "height": 8, "width": 8},
]
# From the moment: 0.2 s of ``silence_s`` at most, and a few ticks until a command says so; then the
# slowest joint brakes from its full speed.
NOTICED_S = 0.3
# Counted in commands: a machine that stands still makes a stop later, and these no more.
STALL_S = 1.5
BRAKING_S = max(joint.velocity / joint.acceleration for joint in ARM.joints)
PAUSED, KILLED, STOPPED = signal.SIGSTOP, signal.SIGKILL, signal.SIGTERM
EXIT_CODES = {PAUSED: 1, KILLED: -signal.SIGKILL, STOPPED: 1}
START_S, END_S = 120.0, 60.0
# A machine that stalls: this program, its main process, or the driver.
STALLED = re.compile(r"did not run this process for|main process did not run for|is silent for")


@pytest.fixture
def crew(drivers):
    return drivers(STREAMS, SINKS, name="robot"), drivers([], SINKS, name="ear")


@pytest.mark.parametrize(
    ("seed", "programs", "chunks", "most"),
    [
        # Two at least; the others only where the machine stalls.
        pytest.param(7, 6, 60, 150, id="some"),
        *(
            pytest.param(seed, 12, 2_000, 2500, id=f"many-{seed}", marks=pytest.mark.slow)
            for seed in range(5)
        ),
    ],
)
def test_nothing_beyond_a_limit_arrives_and_the_arm_rests(
    crew, tmp_path, seed, programs, chunks, most
):
    """Some 60 chunks here, more than 10,000 every night: five tests, each within the watchdog."""
    played, stalled, here, random = 0, 0, HOME, np.random.default_rng(seed)
    for number in range(programs):
        folder = tmp_path / str(number)
        folder.mkdir()
        what = (PAUSED, KILLED, STOPPED)[(number - stalled) % 3]
        program_seed = 1000 * seed + number
        commands = int(random.integers(most // 5, most))
        after, path = play(crew, folder, program_seed, what, commands)
        hold_against_limits(path, here, halts=False)
        here = path[-1]
        if after is None:
            stalled += 1
            continue
        moving, after_s = after
        assert moving <= (NOTICED_S + BRAKING_S) * ARM.rate_hz, f"program {number}, {what.name}"
        assert after_s <= NOTICED_S + BRAKING_S + STALL_S, f"program {number}, {what.name}"
        played += (folder / CHUNKS).stat().st_size
        if played >= chunks and number - stalled >= 2:
            break
    assert played >= chunks
    assert stalled <= programs // 3


def play(crew, folder: Path, seed: int, what: signal.Signals, commands: int):
    """By how many commands and for how long the arm moved after the moment that came when so many
    had, and all commands, ``(N, 3)``. None for the former if the machine stalled, and the arm was
    stopped before the moment, rightly."""
    _, ear = crew
    ear.heard.clear()
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(folder), str(seed)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        wait_for(lambda: len(ear.heard) >= commands or process.poll() is not None, START_S)
        stalled = process.poll() is not None
        moment = time.monotonic()
        process.send_signal(what)
        wait_for(lambda: time.monotonic() - last_motion(ear) > 1.0, END_S)
        process.send_signal(signal.SIGCONT)
        said, _ = process.communicate(timeout=END_S)
    finally:
        process.kill()
        process.wait()
    # What was killed exits so; whoever exits otherwise had ended by itself before.
    stalled |= what is KILLED and process.returncode == 1
    if stalled:
        assert process.returncode == 1, said
        assert STALLED.search(said), said
    else:
        assert process.returncode == EXIT_CODES[what], said
    heard = [(item["at"], item["position"]) for item in ear.on(COMMAND)]
    sent = np.fromfile(folder / SENT).reshape(-1, len(NAMES)).tolist()
    path = with_overtaken([position for _, position in heard], sent)
    if stalled:
        return None, path
    last = last_motion(ear)
    moving = sum(moment < at <= last for at, _ in heard)
    return (moving, max(last - moment, 0.0)), path


def last_motion(ear) -> float:
    """When the last command that moves the arm was received."""
    heard = ear.on(COMMAND)
    return heard[-resting(np.array([item["position"] for item in heard]))]["at"]
