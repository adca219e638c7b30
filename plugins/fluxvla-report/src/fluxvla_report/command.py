"""``fluxvla report DIR``."""

from __future__ import annotations

import argparse


class Report:
    """Write the HTML report of a work dir."""

    api = "1.0"
    help = (
        "Write one HTML page about a work dir: curves, success rates, videos, joints, timings. "
        "Works with whatever is there and says what is not."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("work_dir", metavar="DIR", help="a work dir of fluxvla run")
        parser.add_argument("--out", metavar="FILE", help="default: DIR/report.html")
        parser.add_argument("--title", default="", help="default: the name of the config")

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core.commands import heartbeat
        from fluxvla_report.page import build_report

        with heartbeat(f"writing the report of {args.work_dir}"):
            path = build_report(args.work_dir, args.out, args.title)
        print(path)
        return 0
