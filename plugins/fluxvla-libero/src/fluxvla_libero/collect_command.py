"""``fluxvla collect-libero``: demonstrations of the scripted expert as a dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar


class CollectLiberoCommand:
    """The command's arguments; the work is in ``fluxvla_libero.collect``."""

    api: ClassVar[str] = "1.0"
    help: ClassVar[str] = "Record demonstrations of a scripted expert in LIBERO's scenes."

    def add_arguments(self, parser: Any) -> None:
        from fluxvla_core.evaluate.drawing import RENDERS

        parser.add_argument("--out", required=True, metavar="DIR", help="the dataset to make")
        parser.add_argument("--episodes", type=int, default=100, metavar="N", help="default 100")
        parser.add_argument("--suite", default="libero_object", help="default libero_object")
        parser.add_argument(
            "--tasks", nargs="+", metavar="TASK", help="indices or names; all by default"
        )
        parser.add_argument(
            "--mixed",
            action="store_true",
            help="also do each task in the others' scenes, so that the instruction decides",
        )
        parser.add_argument("--workers", type=int, default=2, metavar="N", help="default 2")
        parser.add_argument("--seed", type=int, default=10_000, help="of the first episode")
        parser.add_argument("--cameras", nargs="+", metavar="NAME", help="both by default")
        parser.add_argument("--height", type=int, default=224, help="of the pictures")
        parser.add_argument("--width", type=int, default=224, help="of the pictures")
        parser.add_argument(
            "--noise", type=float, default=0.0, metavar="SIZE", help="disturb the arm; 0 to 1"
        )
        parser.add_argument(
            "--render", choices=RENDERS, default="cheap", help="how pictures are drawn"
        )
        parser.add_argument(
            "--resume", action="store_true", help="go on with an interrupted collection"
        )
        parser.add_argument(
            "--log-format",
            choices=("text", "json"),
            default="text",
            help="for people (default) or one JSON object a line",
        )

    def run(self, args: Any) -> int:
        from fluxvla_core.cli.reporters import make_reporter
        from fluxvla_core.errors import UsageError
        from fluxvla_libero.collect import Collection, collect
        from fluxvla_libero.embodiment import SCENE_CAMERAS

        if args.workers < 1:
            raise UsageError(f"--workers must be at least 1, got {args.workers}")
        tasks = None
        if args.tasks is not None:
            tasks = tuple(int(task) if task.isdigit() else task for task in args.tasks)
        collection = Collection(
            episodes=args.episodes,
            suite=args.suite,
            tasks=tasks,
            mixed=args.mixed,
            seed=args.seed,
            camera_names=tuple(args.cameras or SCENE_CAMERAS),
            height=args.height,
            width=args.width,
            noise=args.noise,
            render=args.render,
        )
        reporter = make_reporter(args.log_format)
        try:
            reporter.info(f"collecting {args.episodes} demonstrations into {Path(args.out)}")
            found = collect(args.out, collection, args.workers, args.resume, reporter)
            again = f", {found['retried']} tried again" if found["retried"] else ""
            reporter.info(
                f"{found['episodes']} episodes, {found['frames']} new frames{again} in "
                f"{found['seconds']:.0f} s: {found['frames_per_s']:.1f} frames/s"
            )
        finally:
            reporter.close()
        return 0
