"""An adversarial policy and its arm in two processes, for ``test_limits_two_processes``.

    python -c "from tests.ros2.adversarial_program import main; main()" FOLDER SEED

Not ``-m``: the control process has to find the arm's class by the name of its module. Endless
chunks ask for whatever is no motion; each is a byte of the file ``CHUNKS``.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._process_program import ProgramArm
from fluxvla_core import BaseInferenceRunner, RunContext
from fluxvla_core.contracts.policy import Continuation
from fluxvla_core.control.joiners import METHODS
from fluxvla_core.errors import FluxError
from fluxvla_core.plugins.registry import OPERATORS
from tests.ros2.adversarial import ARM, LIMITS_ALONE, MOVES, chunk_of

CHUNKS = "chunks"
# A chunk of these is refused, and ends the episode.
ENDING = ("huge",)
RATES_HZ = (10.0, 25.0)
# The first program has the one that most happens in.
JOINING = ("rtc", *(method for method in METHODS if method != "rtc"))


@OPERATORS.register_module(force=True)
class AdversarialArm(ProgramArm):
    """Goes to each command, if it is one of ours."""

    embodiment = ARM


class RandomAdversary:
    """Any of ``MOVES``, far and near."""

    embodiment = ARM
    horizon = 4

    def __init__(self, folder: Path, random: np.random.Generator) -> None:
        self.random = random
        self.action_rate_hz = float(random.choice(RATES_HZ))
        self.moves = [move for move in MOVES if move not in ENDING]
        # Without a buffer: what was asked before a kill is counted.
        self.file = open(folder / CHUNKS, "ab", buffering=0)  # noqa: SIM115

    def reset(self, seed: int) -> None:
        """Its randomness goes on."""

    def predict_action(self, observation: Mapping[str, Any]) -> np.ndarray:
        self.file.write(b".")
        a, b = self.random.uniform(-1, 1, 2) * self.random.choice([0.2, 50.0])
        move = str(self.random.choice(self.moves))
        return chunk_of(move, a, b, np.asarray(observation["qpos"], dtype=np.float64))

    def continue_action(self, observation: Mapping[str, Any], rest: Continuation) -> np.ndarray:
        """Agrees with what is over by then, and with nothing else."""
        chunk = self.predict_action(observation)
        if chunk.shape != rest.actions.shape:
            return chunk
        return np.where(rest.weights[:, None] == 1.0, rest.actions, chunk)


def main() -> None:
    """Run until something ends it; then exit with its code."""
    folder, seed = Path(sys.argv[1]), int(sys.argv[2])
    random = np.random.default_rng(seed)
    policy = RandomAdversary(folder, random)
    runner = BaseInferenceRunner(
        context=RunContext(section="inference", work_dir=folder, task="1"),
        operator={"type": "AdversarialArm", "folder": str(folder)},
        policy=policy,
        task_descriptions={"1": "do harm"},
        execute_horizon=int(random.integers(1, 5)),
        chunk_joining=JOINING[seed % len(JOINING)],
        max_publish_step=1_000_000,
        safety=LIMITS_ALONE,
        record_fps=None,
        control_process=True,
    )
    runner.run_setup()
    try:
        runner.run()
    except FluxError as error:
        print(error)
        sys.exit(error.exit_code)
