"""An operator may say of itself, as it is set, that it cannot be divided."""

from __future__ import annotations

import numpy as np
import pytest

from fluxvla_core.build import RunContext
from fluxvla_core.contracts.frame import Frame
from fluxvla_core.contracts.robot import Operator
from fluxvla_core.plugins.registry import OPERATORS
from fluxvla_core.robot.process.remote_operator import RemoteOperator
from fluxvla_core.robot.runner import BaseInferenceRunner
from fluxvla_core.spec import EmbodimentSpec, Joint


class Refusing(Operator):
    """Has the methods, as ``URRTDEOperator`` without a gripper has them."""

    api = "1.0"
    embodiment = EmbodimentSpec("arm", (Joint("a", "rad", -1.0, 1.0, 2.0, 10.0),), (), 50.0)

    def connect(self): ...

    def get_frame(self):
        return Frame(np.zeros(1), {}, {})

    def send_action(self, action): ...

    def stop(self): ...

    def close(self): ...

    def without_cameras(self):
        return None

    def without_commands(self):
        return None


@pytest.fixture(autouse=True)
def registered():
    OPERATORS.register_module("Refusing")(Refusing)
    yield
    OPERATORS.unregister("Refusing")


def runner(tmp_path, **arguments):
    context = RunContext(section="inference", work_dir=tmp_path)
    return BaseInferenceRunner(context=context, operator={"type": "Refusing"}, **arguments)


def test_it_runs_as_a_whole_in_the_control_process(tmp_path):
    made = runner(tmp_path, control_process=True)

    assert made.divided
    assert isinstance(made.ros_operator, RemoteOperator)
    assert made.robot.name == "Refusing"


def test_without_a_control_process_it_runs_here(tmp_path):
    made = runner(tmp_path, control_process=False)

    assert not made.divided
    assert isinstance(made.ros_operator, Refusing)
