"""What each way of joining chunks makes of a slow policy: success, time, and smoothness.

    python -m benchmarks.chunk_joining [--checkpoint work_dirs/aloha_sim_transfer] [--episodes 5]

The simulated ALOHA hands the cube over with the policy that the demo trains. The latency is
simulated (time stands still while the policy thinks, and then passes), so that the figures do not
depend on how busy the machine is. They are: successes; seconds until done; the largest step of the
joined target from one command to the next, which is the seam between chunks; and how hard the
commands accelerate (rms over the arms' joints), after the limits took up the seams.
Writes ``benchmarks/results/chunk_joining.json``; without a trained policy it measures nothing.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import _results
from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.control.joiners import METHODS
from fluxvla_core.errors import CheckpointError
from fluxvla_core.infer.local_policy import find_checkpoint, load_policy

TASKS = {
    "1": "pick up the cube with the right arm and hold it",
    "2": "hand the cube over to the left arm",
}
ARM_COLUMNS = [*range(6), *range(7, 13)]
HZ = 50.0


def episode(policy: Any, method: str, latency: float, seed: int) -> dict[str, float]:
    """One episode's figures."""
    with tempfile.TemporaryDirectory() as folder:
        context = RunContext(config={}, section="inference", work_dir=Path(folder), task="2")
        table = {
            "type": "AlohaInferenceRunner",
            "policy": policy,
            "seed": 7 + seed,
            "task_descriptions": TASKS,
            "execute_horizon": 5,
            "max_publish_step": 400,
            "record_fps": None,
            "chunk_joining": method,
            "simulated_latency": latency,
            "operator": {
                "type": "AlohaSimOperator",
                "camera_names": ("top",),
                "height": 144,
                "width": 192,
                "seed": 500 + seed,
            },
        }
        runner = build_runner_from_cfg(table, context)
        runner.run_setup()
        result = runner.run()
        (trace,) = Path(folder).glob("inference/*/trace.jsonl")
        rows = [json.loads(line) for line in trace.read_text().splitlines()]
    sent = [row for row in rows if row["event"] == "command" and row["phase"] == "run"]
    wanted, commands = (
        np.array([row[key] for row in sent])[:, ARM_COLUMNS] for key in ("wanted", "command")
    )
    return {
        "success": float(bool(result["success"])),
        "seconds": result["steps"] / HZ,
        "largest_step_rad": float(np.abs(np.diff(wanted, axis=0)).max()),
        "acceleration_rms": float(np.sqrt(np.square(np.diff(commands, 2, axis=0) * HZ**2).mean())),
    }


def main() -> None:
    parser = _results.options(__file__)
    parser.add_argument("--checkpoint", type=Path, default="work_dirs/aloha_sim_transfer")
    parser.add_argument("--episodes", type=int, default=5, help="for each row")
    parser.add_argument("--latencies", type=float, nargs="+", default=[0.0, 0.2, 0.4])
    arguments = parser.parse_args()
    begun = _results.head("fluxvla-sim", "torch", "mujoco")
    try:
        policy = load_policy(find_checkpoint(None, arguments.checkpoint))
    except CheckpointError as error:
        print(f"nothing is measured: {error}")
        return
    rows = []
    for latency in arguments.latencies:
        for method in METHODS:
            found = [episode(policy, method, latency, seed) for seed in range(arguments.episodes)]
            mean = {key: float(np.mean([each[key] for each in found])) for key in found[0]}
            successes = int(sum(each["success"] for each in found))
            rows.append({"latency_s": latency, "chunk_joining": method, **mean})
            print(
                f"{latency:4.1f} s  {method:18} {successes}/{len(found)}  "
                f"{mean['seconds']:5.2f} s  step {mean['largest_step_rad']:.3f} rad  "
                f"acceleration {mean['acceleration_rms']:.2f} rad/s^2",
                flush=True,
            )
    _results.keep(
        arguments.out, {**begun, "episodes": arguments.episodes, "rows": rows}, show=False
    )


if __name__ == "__main__":
    main()
