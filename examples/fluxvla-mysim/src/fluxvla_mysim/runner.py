"""An evaluation runner, as the page 'Adding Custom Engines' outlines it: no base class needed.

The simulation is as small as one can be: an arm that is always at its command, and a task that is
done when its first joint has turned to the right side.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from fluxvla_core import load_policy

SIZE = 32
SUITES = {"my_benchmark": {"pick up the red cup": 1.0, "place it on the shelf": -1.0}}


class MySimEvalRunner:
    """A custom simulation's evaluation."""

    def __init__(
        self, cfg, seed, ckpt_path, task_suite_name, dataset, denormalize_action, **kwargs
    ):
        self.cfg = cfg
        self.seed = seed
        self.ckpt_path = ckpt_path
        self.tasks = SUITES[task_suite_name]
        self.dataset = dataset
        self.denormalize_action = denormalize_action
        self.trials = kwargs.get("trials", 2)
        self.results = Path(kwargs.get("results", "my_benchmark.json"))

    def run_setup(self):
        """Load the model."""
        self.policy = load_policy(
            self.ckpt_path, dataset=self.dataset, denormalize_action=self.denormalize_action
        )

    def run(self):
        """Evaluate: every task, every trial: reset, act, note the success."""
        rates = {}
        for task, side in self.tasks.items():
            done = [self._trial(task, side, self.seed + n) for n in range(self.trials)]
            rates[task] = sum(done) / len(done)
        self.results.write_text(json.dumps(rates, indent=1))
        return {"success_rate": sum(rates.values()) / len(rates)}

    def _trial(self, task, side, seed):
        self.policy.reset(seed)
        joints = self.policy.embodiment.joints
        pose = np.array([(j.lower + j.upper) / 2 for j in joints])
        for _ in range(5):
            images = {
                c.name: np.full((SIZE, SIZE, 3), 128, np.uint8)
                for c in self.policy.embodiment.cameras
            }
            chunk = self.policy.predict_action(
                {"qpos": pose, "images": images, "task_description": task}
            )
            pose = np.clip(chunk[-1], [j.lower for j in joints], [j.upper for j in joints])
        return bool(side * pose[0] > 0.1)
