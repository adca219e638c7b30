"""A control process whose main process dies in a moment when nobody commands the robot yet."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from fluxvla_core.control.safety import SafetySettings
from fluxvla_core.robot.process import control_main
from fluxvla_core.robot.process.inbox import Inbox, MainSilent
from fluxvla_core.robot.process.link import Link, make_memory

# Starts a control process and dies at once, or as soon as that connects.
MAIN = """
import json, os, sys
from pathlib import Path

from fluxvla_core.control.safety import SafetySettings
from fluxvla_core.plugins.registry import load_plugin_files
from fluxvla_core.robot.episode import EpisodeSettings
from fluxvla_core.robot.process.control_process import launch
from fluxvla_core.robot.process.messages import Kind
from fluxvla_core.robot.process.setup import ControlSetup
from fluxvla_core.spec import EmbodimentSpec, Joint

folder, moment = Path(sys.argv[1]), sys.argv[2]
load_plugin_files([str(folder / "plugin.py")])
spec = EmbodimentSpec("arm", (Joint("a", "rad", -1.0, 1.0, 2.0, 10.0),), (), 50.0)
settings = EpisodeSettings(50.0, SafetySettings(), None, None, 0.0, 100, 10.0)
setup = ControlSetup(
    {}, "inference", str(folder), {"type": "HangingArm", "folder": str(folder)}, spec.to_dict(), [],
    None, ("synchronous", 0.02), settings, None,
)
process, link = launch(setup)
print(process.pid, flush=True)
if moment == "connecting":
    link.send(Kind.CONNECT)
    while not (folder / "connecting").exists():
        pass
os._exit(0)
"""
PLUGIN = """
import time
from pathlib import Path

import fluxvla_core.robot.process.control_main as control_main
from fluxvla_core import OPERATORS

control_main._ORPHANED_S = 1.0


@OPERATORS.register_module()
class HangingArm:
    api = "1.0"

    def __init__(self, folder):
        self.folder = Path(folder)

    def connect(self):
        (self.folder / "connecting").touch()
        time.sleep(1000)

    def get_frame(self): ...
    def send_action(self, action): ...
    def stop(self): ...
    def close(self): ...
    def without_cameras(self):
        return self
    def without_commands(self):
        return self
"""


def test_the_parent_of_later_is_not_the_main_process():
    memory = make_memory()
    inbox = Inbox(Link(memory, control=True), SafetySettings(), main=os.getppid() + 1, rate_hz=50.0)
    os.close(memory)
    assert inbox.orphaned
    with pytest.raises(MainSilent, match="the main process was killed"):
        inbox.check()


@pytest.mark.parametrize("moment", ["at once", "connecting"])
def test_no_control_process_is_left(tmp_path: Path, moment: str) -> None:
    """Whether main dies before it was looked for, or while a call of the operator hangs."""
    (tmp_path / "plugin.py").write_text(PLUGIN)
    line = [sys.executable, "-c", MAIN, str(tmp_path), moment]
    done = subprocess.run(line, stdout=subprocess.PIPE, timeout=120, check=True)

    deadline = time.monotonic() + 60.0
    while _runs(int(done.stdout)):
        assert time.monotonic() < deadline, "the control process outlives the main process"
        time.sleep(0.05)


def test_a_stop_that_failed_is_reported_once(capfd: pytest.CaptureFixture[str]) -> None:
    hung = "Arm.stop did not return within 5 s"
    engine = SimpleNamespace(stop_failure=hung)
    control_main._report_orphaned(engine, [hung, None])
    engine.stop_failure = None
    control_main._report_orphaned(engine, [None, None])

    killed = "fluxvla: the main process was killed; "
    said = f"{killed}stopping the robot failed: {hung}\n{killed}the robot was stopped\n"
    assert capfd.readouterr().err == said


def _runs(pid: int) -> bool:
    try:
        return b"fluxvla_core.robot.process" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False
