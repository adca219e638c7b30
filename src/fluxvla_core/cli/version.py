"""``fluxvla version``."""

from __future__ import annotations

import argparse
import platform

from fluxvla_core.cli.parser import Parser


class Version:
    api = "1.0"
    help = "Print the versions of the core and of Python."

    def add_arguments(self, parser: Parser) -> None:
        return

    def run(self, args: argparse.Namespace) -> int:
        from fluxvla_core import __version__

        print(f"fluxvla-core {__version__}, Python {platform.python_version()}")
        return 0
