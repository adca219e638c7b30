"""Run an evaluation in this process, for tests."""

from __future__ import annotations

from fluxvla_core.build import RunContext
from fluxvla_core.evaluation.runner import EvalRunner

WALK = {"type": "Walk"}


def evaluate(work_dir, environment=WALK, reporter=None, **options):
    more = {} if reporter is None else {"reporter": reporter}
    context = RunContext(work_dir=work_dir, section="eval", **more)
    options = {"policy": "expert", "episodes": 4, "record_videos": 0, **options}
    runner = EvalRunner(context=context, environment=environment, **options)
    runner.run_setup()
    return runner.run()
