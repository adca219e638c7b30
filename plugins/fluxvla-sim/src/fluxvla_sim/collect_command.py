"""``fluxvla collect``: ``fluxvla data collect`` with what suits the simulated robots."""

from __future__ import annotations

from typing import Any, ClassVar


class CollectCommand:
    """The command's arguments; the work is in ``fluxvla_core.evaluation.collect``."""

    api: ClassVar[str] = "1.0"
    help: ClassVar[str] = "Record demonstrations of a scripted expert as a LeRobot v3.0 dataset."

    def add_arguments(self, parser: Any) -> None:
        parser.add_argument("robot", choices=("aloha", "ur5e"), help="the simulated robot")
        parser.add_argument("--out", required=True, metavar="DIR", help="the dataset to make")
        parser.add_argument("--episodes", type=int, default=240, metavar="N", help="default 240")
        parser.add_argument("--workers", type=int, default=2, metavar="N", help="default 2")
        parser.add_argument(
            "--tasks",
            nargs="+",
            metavar="NAME",
            help="aloha: lift_hold, transfer_cube (both by default, in turn), insertion; "
            "ur5e: lift_cube",
        )
        parser.add_argument("--seed", type=int, default=10_000, help="of the first episode")
        parser.add_argument("--fps", type=float, default=10.0, help="frames a second, default 10")
        parser.add_argument(
            "--cameras", nargs="+", metavar="NAME", help="default: the first of the scene"
        )
        parser.add_argument("--height", type=int, default=144, help="of the images")
        parser.add_argument("--width", type=int, default=192, help="of the images")
        parser.add_argument(
            "--noise",
            type=float,
            default=0.0,
            metavar="RAD",
            help="size of smooth noise on the executed commands; the recorded actions stay clean",
        )
        parser.add_argument(
            "--resume", action="store_true", help="continue an interrupted collection"
        )
        parser.add_argument(
            "--log-format",
            choices=("text", "json"),
            default="text",
            help="text (default), or one JSON object per line",
        )

    def run(self, args: Any) -> int:
        from fluxvla_core.commands import collect_demonstrations
        from fluxvla_core.errors import UsageError
        from fluxvla_core.evaluation import Collection
        from fluxvla_sim.environment import ENVIRONMENTS

        if args.workers < 1:
            raise UsageError(f"--workers must be at least 1, got {args.workers}")
        environment = ENVIRONMENTS[args.robot]
        robot = environment.robot
        collection = Collection(
            # What comes after a success teaches too: how to continue after a near miss.
            environment={"type": environment.__name__, "ends_with_success": False},
            policy={"type": "SimExpert", "action_rate_hz": args.fps, "noise": args.noise},
            episodes=args.episodes,
            tasks=tuple(args.tasks or robot.default_tasks),
            seed=args.seed,
            cameras=tuple(args.cameras or robot.cameras[:1]),
            height=args.height,
            width=args.width,
        )
        collect_demonstrations(collection, args)
        return 0
