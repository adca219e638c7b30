"""What ``fluxvla plugins doctor`` says of the machine."""

from __future__ import annotations

import re
import sys

import pytest

from fluxvla_core.cli import machine


def test_the_facts_of_this_machine() -> None:
    found = machine.facts(120.0)
    assert found["python"] == "{}.{}.{}".format(*sys.version_info[:3])
    assert found["disks"][0]["free_bytes"] > 0
    torch = pytest.importorskip("torch")
    assert found["torch"]["version"] == torch.__version__
    assert found["torch"]["cuda"] == torch.version.cuda
    assert found["torch"]["error"] is None
    text = "\n".join(machine.lines(found))
    assert re.search(rf"^  torch +{re.escape(torch.__version__)}; ", text, re.MULTILINE)
    if found["rendering"]["works"]:
        assert found["rendering"]["renderer"] in text


def test_what_ros_2_is_told_by_the_environment() -> None:
    said = {
        "ROS_DISTRO": "kilted",
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "ROS_DOMAIN_ID": "42",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
    }
    found = machine.facts(None, said)
    assert list(machine.remarks(found)) == list(machine.remarks(machine.facts(None, {})))
    (line,) = [line for line in machine.lines(found) if "ROS 2" in line]
    assert line.split(maxsplit=2)[2] == (
        "kilted; RMW rmw_fastrtps_cpp; domain 42; discovery LOCALHOST; "
        "FASTDDS_BUILTIN_TRANSPORTS=UDPv4; no shared memory"
    )


def test_what_is_wrong_with_a_machine() -> None:
    found = machine.facts(None, {"ROS_DOMAIN_ID": "233", "FASTDDS_DEFAULT_PROFILES_FILE": "/gone"})
    found["shared_memory"] = {"path": "/dev/shm", "free_bytes": 1 << 20, "total_bytes": 64 << 20}
    found["disks"] = [{"path": "/data", "free_bytes": 1 << 30, "total_bytes": 1 << 40}]
    found["rendering"] |= {"mujoco": "3.3.0", "backend": "egl", "error": "no EGL"}
    found["torch"] |= {"version": "2.6", "error": "its import fails: ImportError: libcudart"}
    assert list(machine.remarks(found)) == [
        (True, "torch 2.6 is installed and its import fails: ImportError: libcudart"),
        (True, "ROS_DOMAIN_ID is '233', and a ROS domain is a number from 0 to 232"),
        (
            True,
            "FASTDDS_DEFAULT_PROFILES_FILE names /gone, which is not there: Fast DDS goes on "
            "without it",
        ),
        (
            False,
            "MuJoCo cannot render (MUJOCO_GL=egl): no EGL; without a display, MUJOCO_GL=egl needs "
            "libegl1 and, on a machine without a GPU, libegl-mesa0 and libgl1-mesa-dri",
        ),
        (False, "1.0 GiB are free in /data"),
        (
            False,
            "/dev/shm has 64 MiB, and workers that load data pass batches through it: "
            "docker run --shm-size=8g",
        ),
    ]


@pytest.mark.parametrize(
    ("program", "seconds", "error"),
    [
        ("import time; time.sleep(60)", 1.0, "its import did not end in 1 s"),
        (
            "import os, signal; os.kill(os.getpid(), signal.SIGKILL)",
            60.0,
            "its import fails: exit status -9",
        ),
        ("raise ImportError('libcudart')", 60.0, "its import fails: ImportError: libcudart"),
    ],
)
def test_an_import_that_breaks_its_process_is_an_answer(
    program: str, seconds: float, error: str
) -> None:
    assert machine._asked(program, seconds) == {"error": error}
