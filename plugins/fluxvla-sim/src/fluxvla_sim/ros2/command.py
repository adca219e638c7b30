"""``fluxvla sim``: a simulated robot that other programs drive over ROS 2."""

from __future__ import annotations

from typing import Any, ClassVar

from fluxvla_mujoco import RENDERS

from fluxvla_core.errors import UsageError


class SimCommand:
    """The command's arguments; the work is in ``fluxvla_sim.ros2.node``."""

    api: ClassVar[str] = "1.0"
    help: ClassVar[str] = "Simulate a robot behind the ROS 2 topics of the real one."

    def add_arguments(self, parser: Any) -> None:
        parser.add_argument("robot", choices=("aloha", "ur5e"), help="which robot")
        parser.add_argument(
            "--ros2", action="store_true", help="over ROS 2 (there is no other way)"
        )
        parser.add_argument(
            "--task",
            metavar="NAME",
            help="ALOHA: insertion puts peg and socket in the cube's place",
        )
        parser.add_argument("--seed", type=int, default=0, help="places the objects, default 0")
        parser.add_argument(
            "--real-time-factor",
            type=float,
            default=1.0,
            metavar="F",
            help="simulated seconds in a second, for a machine that is too slow; default 1. The "
            "operator needs the same real_time_factor",
        )
        parser.add_argument(
            "--camera-hz",
            type=float,
            default=30.0,
            metavar="HZ",
            help="of each camera that is listened to, in simulated time; default 30",
        )
        parser.add_argument(
            "--state-hz",
            type=float,
            default=50.0,
            metavar="HZ",
            help="of joint states and everything except images, up to 500, in simulated time; "
            "default 50",
        )
        parser.add_argument(
            "--latency",
            action="append",
            default=[],
            metavar="STREAM=SECONDS",
            help="how long a stream's messages are under way, in simulated time; their stamps say "
            "when they were made",
        )
        parser.add_argument("--height", type=int, default=480, help="of the images")
        parser.add_argument("--width", type=int, default=640, help="of the images")
        parser.add_argument(
            "--render", choices=RENDERS, default="cheap", help="quality of the images"
        )
        parser.add_argument(
            "--cameras", nargs="+", metavar="NAME", help="the scene's cameras; all by default"
        )
        parser.add_argument(
            "--preset",
            default="cobot_magic",
            help="ALOHA: cobot_magic (default) or interbotix topics",
        )
        parser.add_argument(
            "--controller",
            default="forward_position_controller",
            help="UR: the controller that is active",
        )
        parser.add_argument(
            "--speed-scaling",
            type=float,
            metavar="PERCENT",
            help="UR: the teach pendant's speed slider, default 100; a number on "
            "/sim/speed_scaling moves it",
        )
        parser.add_argument(
            "--best-effort", action="store_true", help="offer images as camera drivers do"
        )
        parser.add_argument(
            "--fault",
            action="append",
            default=[],
            metavar="STREAM=MODE[:AMOUNT][@S]",
            help="give a stream a fault, S seconds after the start (also at any time, as text on "
            f"/sim/fault; STREAM=well ends it). {_modes()}. Streams of aloha: 'left arm', 'right "
            "arm', base, top, left_wrist, right_wrist; of ur5e: arm, gripper, 'speed scaling', "
            "front, wrist; a camera's distances: top_depth, …",
        )
        parser.add_argument("--domain-id", type=int, metavar="N", help="ROS domain")
        parser.add_argument("--seconds", type=float, metavar="S", help="end by itself")
        parser.add_argument(
            "--log-format",
            choices=("text", "json"),
            default="text",
            help="text (default), or one JSON object per line",
        )

    def run(self, args: Any) -> int:
        from fluxvla_core.commands import make_reporter
        from fluxvla_core.ros2 import require_rclpy
        from fluxvla_sim.ros2.settings import stream_latency, timed_fault

        if not args.ros2:
            raise UsageError(
                "a simulated robot is reached over ROS 2 here",
                next=f"fluxvla sim {args.robot} --ros2; in one process with the policy, use "
                "operator=dict(type='AlohaSimOperator') in the config",
            )
        faults = [timed_fault(text) for text in args.fault]
        latencies = dict(map(stream_latency, args.latency))
        require_rclpy()
        reporter = make_reporter(args.log_format)
        try:
            return self._simulate(args, faults, latencies, reporter)
        finally:
            reporter.close()

    def _simulate(
        self, args: Any, faults: list[Any], latencies: dict[str, float], reporter: Any
    ) -> int:
        from fluxvla_sim.environment import ENVIRONMENTS
        from fluxvla_sim.ros2.node import simulate
        from fluxvla_sim.ros2.settings import NodeSettings, check_fault, check_stream

        robot = ENVIRONMENTS[args.robot].robot
        world, _ = robot.find(args.task or robot.default_tasks[0])
        driver = _aloha(args) if args.robot == "aloha" else _ur(args)
        _some_cameras(driver, args.cameras)
        for _, stream, fault in faults:
            check_fault(driver, stream, fault)
        for stream in latencies:
            check_stream(driver, stream)
        settings = NodeSettings(
            name=args.robot,
            seed=args.seed,
            real_time_factor=args.real_time_factor,
            state_hz=args.state_hz,
            camera_hz=args.camera_hz,
            latencies=latencies,
            height=args.height,
            width=args.width,
            best_effort=args.best_effort,
            faults=faults,
            domain_id=args.domain_id,
        )
        simulate(driver, world, settings, reporter, args.render, args.seconds)
        return 0


def _modes() -> str:
    from fluxvla_core.ros2 import AMOUNTS, MODES

    names = {mode: f"{mode}:AMOUNT" if mode in AMOUNTS else mode for mode in MODES}
    return "; ".join(f"{names[mode]}: {what}" for mode, what in MODES.items())


def _some_cameras(driver: Any, names: list[str] | None) -> None:
    unknown = [name for name in names or () if name not in driver.cameras]
    if unknown:
        raise UsageError(
            f"no camera {', '.join(map(repr, unknown))}; there are {', '.join(driver.cameras)}"
        )
    if names:
        driver.cameras = {name: driver.cameras[name] for name in names}


def _aloha(args: Any) -> Any:
    from fluxvla_aloha.presets import PRESETS

    from fluxvla_sim.ros2.drivers import AlohaDriver

    if args.preset not in PRESETS:
        raise UsageError(f"unknown preset {args.preset!r}; known are {', '.join(PRESETS)}")
    if args.speed_scaling is not None:
        raise UsageError("an ALOHA has no speed slider: --speed-scaling is for a UR")
    return AlohaDriver(PRESETS[args.preset])


def _ur(args: Any) -> Any:
    from fluxvla_ur.operator import CONTROLLERS

    from fluxvla_sim.ros2.drivers import URDriver

    if args.controller not in CONTROLLERS:
        raise UsageError(
            f"unknown controller {args.controller!r}; known are {', '.join(CONTROLLERS)}"
        )
    return URDriver(args.controller, 100.0 if args.speed_scaling is None else args.speed_scaling)
