"""Tasks on a robot that a process of its own commands: held in between, stopped, re-armed."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from benchmarks._robot_faults import COMMAND, NAMES, BenchArm, Swing, stage_crew
from fluxvla_core import OPERATORS, BaseInferenceRunner, RunContext
from tests.robot.test_task_topic import TOPIC, Somebody

pytestmark = [pytest.mark.network, pytest.mark.realtime]


@pytest.fixture
def stage(tmp_path):
    OPERATORS.register_module()(BenchArm)
    with stage_crew() as make:
        yield make(tmp_path)
    OPERATORS.unregister(BenchArm.__name__)


class Hogging(Swing):
    """Holds the GIL in one of its answers, in motion."""

    left = -1

    def predict_action(self, observation):
        self.left -= 1
        if self.left == 0:
            sum(range(60_000_000))
        return super().predict_action(observation)


def test_tasks_are_done_held_stopped_and_done_again_after_a_rearm(stage, tmp_path):
    policy, somebody = Hogging(), Somebody()
    runner = BaseInferenceRunner(
        context=RunContext(section="inference", work_dir=tmp_path),
        operator={"type": "BenchArm"},
        policy=policy,
        task_descriptions={"1": "swing"},
        task_topic=TOPIC,
        async_execution=True,
        record_fps=None,
        max_publish_step=50,
        control_process=True,
    )
    runner.run_setup()
    seen = {}

    def heard():
        return [h["position"] for h in stage.ear.on(COMMAND) if tuple(h["name"]) == NAMES]

    def person():
        try:
            somebody.hears(f"waiting for a task on {TOPIC}")
            somebody.say("1")
            somebody.hears("1: max_steps, 50 commands")
            before = len(heard())
            until = time.monotonic() + 20
            while len(heard()) < before + 25:
                assert time.monotonic() < until, "the arm is not held between two tasks"
                time.sleep(0.02)
            seen["held"] = heard()[-20:]
            maps = Path(f"/proc/{runner._engine._process.pid}/maps").read_text()
            seen["shared"] = [line for line in maps.splitlines() if "/dev/shm/fastdds" in line]
            policy.left = 10
            somebody.say("1")
            somebody.hears("the main process did not run for")
            somebody.heard.clear()
            somebody.say("1")
            somebody.hears("still stopped by rule main process")
            seen["stopped"] = len(heard())
            somebody.say("rearm")
            somebody.hears("motion is allowed again")
            somebody.heard.clear()
            somebody.say("1")
            somebody.hears("1: max_steps, 50 commands")
            seen["again"] = len(heard())
        except BaseException as error:  # noqa: BLE001 - raised in the test's own thread
            seen["failed"] = error
        finally:
            runner._engine._interrupts._pending = 15  # as SIGTERM does

    thread = threading.Thread(target=person)
    thread.start()
    try:
        with pytest.raises(Exception, match="stopped by SIGTERM"):
            runner.run()
    finally:
        thread.join()
        somebody.connection.close()

    assert seen.get("failed") is None
    assert all(command == seen["held"][-1] for command in seen["held"])
    assert seen["again"] > seen["stopped"]
    # A process that is stopped while it has a lock of Fast DDS's shared memory must stop no arm.
    assert seen["shared"] == []
    assert [trip.rule for trip in runner.latch.trips] == ["main process"]
