"""Benchmarks the time from a fault until the arm rests, as seen from the other side of DDS.

    python -m benchmarks.time_to_hold [--rounds 5] [--only WORDS]

The real runner moves an arm of three joints over ROS 2; the faults are provoked for real
(``_robot_fault_list``; with a control process ``_process_faults``, and ``_whole_faults``, where the
arm is in that process and stores itself what it receives). The time is from the fault
to the receipt, in another process, of the first command that is not changed any more. It contains
what is allowed before something counts as a fault: ``max_age_s`` (0.5 s) of silence,
``tracking_time_s`` (0.25 s) away from the command, ``silence_s`` (0.2 s) without the main process.
Loopback only. Writes ``benchmarks/results/time_to_hold.json``, which docs/safety.md quotes.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import _process_faults, _results, _robot_faults, _whole_faults
from benchmarks._process_faults import CYCLONE_FAULT, PROCESS_FAULTS
from benchmarks._robot_fault_list import FAULTS
from benchmarks._robot_faults import Fault, Result, Stage, stage_crew
from benchmarks._whole_faults import WHOLE_FAULTS

NO_HOLD = "no hold: the last command stays"
ALL = (*FAULTS, *PROCESS_FAULTS, CYCLONE_FAULT, *WHOLE_FAULTS)


def played(stage: Callable[[Path], Stage], folder: Path, fault: Fault) -> Result:
    """One fault, as often as it needs to come about.

    Raises:
        AssertionError: it did not.
    """
    for attempt in range(fault.attempts):
        if fault in WHOLE_FAULTS:
            result = _whole_faults.play(folder / str(attempt), fault)
        elif fault in (*PROCESS_FAULTS, CYCLONE_FAULT):
            # Drivers that still know a killed process may keep their images from the next one.
            with stage_crew(fault.environment) as fresh:
                result = _process_faults.play(fresh(folder / str(attempt)), fault)
        else:
            result = _robot_faults.play(stage(folder / str(attempt)), fault)
        if result.provoked:
            return result
    raise AssertionError(f"{fault.name}: not provoked in {fault.attempts} attempts: {result.said}")


def measured(fault: Fault, results: list[Result]) -> dict[str, Any]:
    """One fault's figures."""
    holds = [result.hold_s for result in results if result.hold_s is not None]
    found: dict[str, Any] = {"outcome": fault.outcome, "exit_code": fault.exit_code}
    found["said"] = results[0].said.partition("\n")[0]
    if holds:
        found["hold_s"] = [round(hold, 3) for hold in holds]
        found["median_s"] = round(statistics.median(holds), 2)
        found["max_s"] = round(max(holds), 2)
    return found


def shown(found: dict[str, Any]) -> str:
    """The column 'time to hold' of docs/safety.md, of one fault's figures.

    Without a command after the fault the time is 0: nothing holds the arm.
    """
    without = {"refused": "nothing moves", "goes on": "goes on"}.get(found["outcome"])
    return without or _time(found["max_s"])


def _time(seconds: float) -> str:
    return f"{seconds:.2f} s" if round(seconds, 2) else NO_HOLD


def main() -> int:
    """Measure, print and write; 1 if a fault was not named as it should be."""
    parser = _results.options(__file__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", default="", help="measure these again, keep the others")
    args = parser.parse_args()
    begun = _results.head("rclpy")
    faults = [fault for fault in ALL if args.only in fault.name]
    results: dict[str, list[Result]] = {fault.name: [] for fault in faults}
    wrong = []
    with stage_crew() as stage, tempfile.TemporaryDirectory() as folder:
        for number in range(args.rounds):
            for index, fault in enumerate(faults):
                result = played(stage, Path(folder) / f"{number}-{index}", fault)
                results[fault.name].append(result)
                hold = "" if result.hold_s is None else _time(result.hold_s)
                agrees = fault.matches(result.said) and result.exit_code == fault.exit_code
                mark = "" if agrees else "  NOT AS EXPECTED"
                wrong += [fault.name] if mark else []
                print(f"{fault.name}: {hold} {result.exit_code} {result.said}{mark}", flush=True)
    found = {fault.name: measured(fault, results[fault.name]) for fault in faults}
    if args.only:
        before = json.loads(args.out.read_text(encoding="utf-8"))
        found = {fault.name: {**before["faults"], **found}[fault.name] for fault in ALL}
        args.rounds = min(args.rounds, before["rounds"])
    summary = {
        **begun,
        "what": "from a fault to the receipt of the command at which the arm rests",
        "rounds": args.rounds,
        "faults": found,
    }
    _results.keep(args.out, summary, show=False)
    if wrong:
        print(f"not as expected: {', '.join(wrong)}", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
