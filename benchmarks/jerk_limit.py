"""Benchmarks the jerk limit: time from rest to rest against the least possible, and compute time.

    python -m benchmarks.jerk_limit [--rounds 2000]

A joint of a ViperX is sent over ways of several lengths by the limiter, with and without a jerk
limit. The least time for the same limits is Ruckig's (``pip install ruckig``, MIT; without it that
column is empty), which plans in continuous time; a limiter that knows no plan, only the next
target, cannot be faster. Also, what one command of 14 joints costs on this machine. Writes
``benchmarks/results/jerk_limit.json``.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from fluxvla_aloha.embodiment import aloha_spec

from benchmarks import _results
from fluxvla_core.control.limits import CommandLimiter
from fluxvla_core.spec import EmbodimentSpec, Joint

HZ = 50.0
LIMITS = {"velocity": 3.14, "acceleration": 20.0}
JERKS = (None, 1000.0, 400.0, 100.0)
WAYS = (0.01, 0.1, 0.5, 2.0)


def limited_s(way: float, jerk: float | None) -> float:
    """Seconds from rest at 0 to rest at ``way``, as the limiter sends it."""
    joint = Joint("j", "rad", -0.1, 3.0, **LIMITS, jerk=jerk)
    limiter = CommandLimiter(EmbodimentSpec("one", (joint,), (), HZ), 1 / HZ)
    limiter.start([0.0])
    commands = 0
    while not (limiter.at_rest and limiter.last[0] == way):
        limiter.step([way])
        commands += 1
    # The last of them only says that it rests.
    return (commands - 1) / HZ


def least_s(way: float, jerk: float | None) -> float | None:
    """The same by Ruckig; None where it is not installed."""
    try:
        from ruckig import InputParameter, Ruckig, Trajectory
    except ImportError:
        return None
    wanted = InputParameter(1)
    wanted.current_position, wanted.target_position = [0.0], [way]
    wanted.max_velocity, wanted.max_acceleration = [LIMITS["velocity"]], [LIMITS["acceleration"]]
    if jerk is not None:
        wanted.max_jerk = [jerk]
    trajectory = Trajectory(1)
    Ruckig(1).calculate(wanted, trajectory)
    return float(trajectory.duration)


def command_us(jerk: float | None, rounds: int) -> float:
    """Microseconds for one command of an ALOHA, median."""
    arms = aloha_spec((), HZ)
    joints = tuple(j if j.kind == "gripper" else replace(j, jerk=jerk) for j in arms.joints)
    limiter = CommandLimiter(replace(arms, joints=joints), 1 / HZ)
    middle = (limiter.lower + limiter.upper) / 2
    limiter.start(middle)
    times = []
    for index in range(rounds):
        target = middle + 0.3 * np.sin(index / 20)
        began = time.perf_counter()
        limiter.step(target)
        times.append(time.perf_counter() - began)
    return float(np.median(times)) * 1e6


def main() -> None:
    parser = _results.options(__file__)
    parser.add_argument("--rounds", type=int, default=2000)
    arguments = parser.parse_args()
    begun = _results.head("numpy", "ruckig")
    rows = []
    for jerk in JERKS:
        for way in WAYS:
            rows.append(
                {
                    "jerk": jerk,
                    "way_rad": way,
                    "limiter_s": limited_s(way, jerk),
                    "least_s": least_s(way, jerk),
                }
            )
    cost = {str(jerk): command_us(jerk, arguments.rounds) for jerk in JERKS}
    _results.keep(arguments.out, {**begun, **LIMITS, "rows": rows, "command_us": cost})


if __name__ == "__main__":
    main()
