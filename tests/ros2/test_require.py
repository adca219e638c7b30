"""Getting rclpy, or saying how to."""

from __future__ import annotations

import importlib
import subprocess
import sys

import pytest

from fluxvla_core.errors import ConfigError, LoadFailed
from fluxvla_core.ros2 import connection, message_class, require_rclpy
from fluxvla_core.ros2.messages import type_name


@pytest.fixture
def no_rclpy(monkeypatch):
    """Let every import of rclpy fail with the error given."""
    real = importlib.import_module

    def hide(error):
        def find(name, *args):
            if name == "rclpy":
                raise error
            return real(name, *args)

        monkeypatch.setattr(connection.importlib, "import_module", find)

    return hide


def test_without_ros_the_message_says_how_to_get_it(no_rclpy):
    no_rclpy(ModuleNotFoundError("No module named 'rclpy'"))

    with pytest.raises(LoadFailed) as caught:
        require_rclpy({})

    assert str(caught.value) == (
        "ROS 2 cannot be used: importing rclpy fails (No module named 'rclpy')\n"
        "  likely cause: no ROS 2 is installed for this Python, or its setup file was not sourced\n"
        "  next: on a robot, source /opt/ros/<distribution>/setup.bash and use the Python that ROS "
        "was built for; for development (Linux, x86-64), pip install 'fluxvla-core[ros2]'"
    )
    assert caught.value.exit_code == 2


def test_what_generates_the_code_of_messages_is_not_loaded():
    """It is 17 MB of parsers, in every process of a robot."""
    probe = """if True:
        import sys
        from fluxvla_core.ros2 import require_rclpy
        require_rclpy()
        import rosidl_generator_py
        assert "generate_py" not in vars(rosidl_generator_py)
        assert "lark" not in sys.modules
        from rosidl_generator_py.generate_py_impl import generate_py
        print(callable(generate_py))
    """
    pytest.importorskip("rclpy")

    assert subprocess.check_output([sys.executable, "-c", probe], text=True) == "True\n"


@pytest.mark.parametrize(
    ("error", "environ", "cause"),
    [
        (
            "librmw_fastrtps_cpp.so: cannot open shared object file",
            {},
            "a library of ROS 2 is missing (with wheels: ros-kilted-rmw-fastrtps-cpp)",
        ),
        (
            "No module named 'rclpy._rclpy_pybind11'",
            {"ROS_DISTRO": "humble"},
            "ROS 2 humble is built for Python 3.10, this is Python 3.99",
        ),
        (
            "No module named 'rclpy'",
            {"ROS_DISTRO": "rolling"},
            "ROS 2 rolling is sourced, but this Python does not see its packages",
        ),
    ],
)
def test_the_likely_cause_is_named(no_rclpy, monkeypatch, error, environ, cause):
    no_rclpy(ImportError(error))
    monkeypatch.setattr(connection.sys, "version_info", (3, 99, 0))

    with pytest.raises(LoadFailed) as caught:
        require_rclpy(environ)

    assert caught.value.cause == cause


def test_a_middleware_that_is_not_there_is_refused_before_it_ends_the_process(monkeypatch):
    monkeypatch.setattr(connection.importlib, "import_module", lambda name: sys)

    with pytest.raises(LoadFailed, match="RMW_IMPLEMENTATION is 'rmw_nothing_cpp'") as caught:
        require_rclpy({"RMW_IMPLEMENTATION": "rmw_nothing_cpp"})

    assert caught.value.next.startswith("unset RMW_IMPLEMENTATION")


def test_the_middleware_that_is_there_is_accepted(ros_domain):
    assert require_rclpy({"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}).__name__ == "rclpy"


@pytest.mark.parametrize("path", ["sensor_msgs.msg:JointState", "sensor_msgs/msg/JointState"])
def test_messages_are_found_by_their_dotted_name(ros_domain, path):
    found = message_class(path)

    assert found.__name__ == "JointState"
    assert type_name(found) == "sensor_msgs/msg/JointState"


def test_a_name_of_another_form_is_a_config_error():
    with pytest.raises(ConfigError, match="'JointState' names no ROS message type"):
        message_class("JointState")


def test_a_missing_message_package_is_named_with_its_apt_package():
    with pytest.raises(LoadFailed, match="interbotix_nothing_msgs") as caught:
        message_class("interbotix_nothing_msgs.msg:JointGroupCommand")

    assert "apt install ros-$ROS_DISTRO-interbotix-nothing-msgs" in caught.value.next


def test_a_missing_message_is_named_with_those_that_exist(ros_domain):
    with pytest.raises(LoadFailed, match=r"has no Flaot64; it has .*Float64") as caught:
        message_class("std_msgs.msg:Flaot64")

    assert caught.value.exit_code == 2


def test_importing_the_room_imports_no_ros():
    probe = (
        "import pkgutil, importlib, sys, fluxvla_core.ros2 as room\n"
        "for module in pkgutil.iter_modules(room.__path__):\n"
        "    importlib.import_module(f'fluxvla_core.ros2.{module.name}')\n"
        "print(sorted({m.partition('.')[0] for m in sys.modules} & "
        "{'rclpy', 'sensor_msgs', 'cv2', 'torch'}))"
    )
    found = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True)

    assert found.stdout.strip() == "[]", found.stderr
