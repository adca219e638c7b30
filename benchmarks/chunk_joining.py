"""Benchmarks the ways of joining chunks with a slow policy: success, time, and smoothness.

    python -m benchmarks.chunk_joining [--checkpoint work_dirs/aloha_sim_transfer] [--episodes 5]

Two policies drive the simulated ALOHA. *trained* is the demo's, which hands the cube over; without
its checkpoint that part is left as it was measured before. *wavering* needs none: its chunks follow
one motion, each shifted from it by an offset of its own, as those of a policy that cannot make up
its mind; it is run with the arms' own limits, and with a jerk limit besides. The latency is
simulated (time stands still while the policy thinks, and then passes), so that the figures do not
depend on how busy the machine is. They are: seconds until done, and successes; the largest step of
the joined target from one command to the next, which is the seam between chunks; and acceleration
and jerk of the commands (rms over the arms' joints, and the largest jerk), after the limits took up
the seams. Writes ``benchmarks/results/chunk_joining.json``.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from fluxvla_aloha.embodiment import CAMERAS, aloha_spec, start_pose
from fluxvla_sim.operators import AlohaSimOperator

from benchmarks import _results
from fluxvla_core.build import RunContext, build_runner_from_cfg
from fluxvla_core.contracts.policy import Continuation
from fluxvla_core.control.joiners import METHODS
from fluxvla_core.errors import CheckpointError
from fluxvla_core.policies.loading import find_checkpoint, load_policy
from fluxvla_core.spec import EmbodimentSpec, Joint

Array = npt.NDArray[np.float64]
TASKS = {
    "1": "pick up the cube with the right arm and hold it",
    "2": "hand the cube over to the left arm",
}
ARM_COLUMNS = [*range(6), *range(7, 13)]
HZ = 50.0
CAMERA = replace(CAMERAS[0], name="top", height=144, width=192)
ARMS = aloha_spec((CAMERA,), HZ)
# Not a limit of the maker's, who states none: a fifth of what these arms are asked for without it.
JERK = 400.0


class Wavering:
    """Swings the arms' joints; each chunk is shifted from the swing by up to ``offset`` rad.

    When it has to continue a chunk, it repeats the given part of that.
    """

    embodiment = aloha_spec(CAMERAS[:0], HZ)
    action_rate_hz, horizon = 10.0, 10

    def __init__(self, now: Callable[[], float], offset: float = 0.05) -> None:
        self.now = now
        self.offset = offset

    def reset(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def predict_action(self, observation: Mapping[str, Any]) -> Array:
        times = self.now() + np.arange(1, self.horizon + 1) / self.action_rate_hz
        chunk = np.repeat(np.array(start_pose("viperx300"))[None], self.horizon, axis=0)
        shift = self.rng.uniform(-self.offset, self.offset, len(ARM_COLUMNS))
        chunk[:, ARM_COLUMNS] += 0.2 * np.sin(2.0 * times)[:, None] + shift
        return chunk

    def continue_action(self, observation: Mapping[str, Any], rest: Continuation) -> Array:
        kept = rest.weights[:, None]
        mixed: Array = kept * rest.actions + (1.0 - kept) * self.predict_action(observation)
        return mixed


def drive(
    policy: Any,
    method: str,
    latency: float,
    seed: int,
    limits: EmbodimentSpec = ARMS,
    task: str = "2",
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """One episode's result and the events of its record; ``policy`` None is the one that wavers."""
    operator = AlohaSimOperator(
        camera_names=("top",), height=CAMERA.height, width=CAMERA.width, seed=500 + seed
    )
    with tempfile.TemporaryDirectory() as folder:
        context = RunContext(config={}, section="inference", work_dir=Path(folder), task=task)
        table = {
            "type": "AlohaInferenceRunner",
            "policy": policy or Wavering(operator.clock.now),
            "operator": operator,
            "embodiment": limits,
            "seed": 7 + seed,
            "task_descriptions": TASKS,
            "execute_horizon": 5,
            "max_publish_step": 400,
            "record_fps": None,
            "chunk_joining": method,
            "simulated_latency": latency,
        }
        runner = build_runner_from_cfg(table, context)
        runner.run_setup()
        result = runner.run()
        (trace,) = Path(folder).glob("inference/*/trace.jsonl")
        return result, [json.loads(line) for line in trace.read_text().splitlines()]


def commands(events: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The commands of a record that a policy is behind."""
    return [row for row in events if row["event"] == "command" and row["phase"] == "run"]


def episode(
    policy: Any, method: str, latency: float, seed: int, limits: EmbodimentSpec = ARMS
) -> dict[str, float]:
    """One episode's figures; ``policy`` None is the one that wavers."""
    result, events = drive(policy, method, latency, seed, limits)
    wanted, sent = (
        np.array([row[key] for row in commands(events)])[:, ARM_COLUMNS]
        for key in ("wanted", "command")
    )
    jerk = np.diff(sent, 3, axis=0) * HZ**3
    return {
        "success": float(bool(result["success"])),
        "seconds": result["steps"] / HZ,
        "largest_step_rad": float(np.abs(np.diff(wanted, axis=0)).max()),
        "acceleration_rms": float(np.sqrt(np.square(np.diff(sent, 2, axis=0) * HZ**2).mean())),
        "jerk_rms": float(np.sqrt(np.square(jerk).mean())),
        "largest_jerk": float(np.abs(jerk).max()),
    }


def measured(
    policy: Any, method: str, latency: float, episodes: int, limits: EmbodimentSpec = ARMS
) -> dict[str, Any]:
    """One row: the mean of some episodes, of the largest jerk the largest."""
    found = [episode(policy, method, latency, seed, limits) for seed in range(episodes)]
    row: dict[str, Any] = {key: float(np.mean([each[key] for each in found])) for key in found[0]}
    row["largest_jerk"] = max(each["largest_jerk"] for each in found)
    print(
        f"{latency:4.1f} s  {method:18} {int(row['success'] * episodes)}/{episodes}  "
        f"{row['seconds']:5.2f} s  step {row['largest_step_rad']:.3f} rad  acceleration "
        f"{row['acceleration_rms']:.2f} rad/s^2  jerk {row['jerk_rms']:.0f} rad/s^3, at most "
        f"{row['largest_jerk']:.0f}",
        flush=True,
    )
    return {"latency_s": latency, "chunk_joining": method, **row}


def main() -> None:
    parser = _results.options(__file__)
    parser.add_argument("--checkpoint", type=Path, default="work_dirs/aloha_sim_transfer")
    parser.add_argument(
        "--episodes", type=int, default=5, help="for each row of the trained policy"
    )
    parser.add_argument("--latencies", type=float, nargs="+", default=[0.0, 0.2, 0.4])
    arguments = parser.parse_args()
    begun = _results.head("fluxvla-sim", "torch", "mujoco")
    cases = [(latency, method) for latency in arguments.latencies for method in METHODS]
    parts: dict[str, Any] = {}
    if arguments.out.is_file():
        parts = json.loads(arguments.out.read_text(encoding="utf-8"))
    smooth = replace(ARMS, joints=tuple(_limited(joint) for joint in ARMS.joints))
    for name, limits in (("wavering", ARMS), ("wavering_with_jerk_limit", smooth)):
        print(name)
        rows = [measured(None, method, latency, 1, limits) for latency, method in cases]
        parts[name] = {**begun, "episodes": 1, "rows": rows}
    try:
        policy = load_policy(find_checkpoint(None, arguments.checkpoint))
    except CheckpointError as error:
        print(f"the trained policy is left as it was measured before: {error}")
    else:
        count = arguments.episodes
        rows = [measured(policy, method, latency, count) for latency, method in cases]
        parts["trained"] = {**begun, "episodes": count, "rows": rows}
    parts["jerk_limit"] = JERK
    _results.keep(arguments.out, parts, show=False)


def _limited(joint: Joint) -> Joint:
    return joint if joint.kind == "gripper" else replace(joint, jerk=JERK)


if __name__ == "__main__":
    main()
