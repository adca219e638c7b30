"""``python -m tools.demo``, inside the environment that nox made for it."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from tools import shell
from tools.demo.run import Demo
from tools.demo.sizes import SIZES

AGAIN = "run the same command again: what is done is kept, and training goes on"


def parser() -> argparse.ArgumentParser:
    """The demo's arguments, as they stand behind ``nox -s demo --``."""
    made = argparse.ArgumentParser("nox -s demo --", allow_abbrev=False)
    size = made.add_mutually_exclusive_group()
    size.add_argument(
        "--smoke", dest="size", action="store_const", const="smoke", help="every stage, tiny"
    )
    size.add_argument(
        "--full",
        dest="size",
        action="store_const",
        const="full",
        help="train as long as it takes for a good policy",
    )
    made.add_argument("--fresh", action="store_true", help="delete this form's results first")
    made.add_argument("--out", type=Path, default=Path("demo_out"), help="default: demo_out")
    made.add_argument("--build", default="", help=argparse.SUPPRESS)
    made.add_argument("--installed-in", type=float, default=0.0, help=argparse.SUPPRESS)
    made.set_defaults(size="default")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Returns the exit code: 0, that of the command that failed, or 130 when interrupted."""
    args = parser().parse_args(argv)
    root = args.out / args.size
    if args.fresh and root.exists():
        shutil.rmtree(root)
    try:
        Demo(SIZES[args.size], root, args.build, args.installed_in).run()
    except shell.StepFailed as error:
        print(f"\n{error}\nOnce the cause is removed, {AGAIN}.", file=sys.stderr)
        return error.status if 0 < error.status < 126 else 1
    except KeyboardInterrupt:
        print(f"\ninterrupted. To go on, {AGAIN}.", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
