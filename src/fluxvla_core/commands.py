"""Subcommands of the ``fluxvla`` program: what a plugin's own one is written with."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fluxvla_core import _lazy

if TYPE_CHECKING:
    from fluxvla_core.cli.choose_reporter import make_reporter as make_reporter
    from fluxvla_core.cli.data_commands import collect_demonstrations as collect_demonstrations
    from fluxvla_core.cli.reporters import heartbeat as heartbeat
    from fluxvla_core.contracts.reporter import Reporter as Reporter
    from fluxvla_core.contracts.reporter import SilentReporter as SilentReporter
    from fluxvla_core.contracts.runner import Command as Command

__getattr__, __dir__, __all__ = _lazy.attach(
    __name__,
    {
        "fluxvla_core.cli.data_commands": ["collect_demonstrations"],
        "fluxvla_core.cli.choose_reporter": ["make_reporter"],
        "fluxvla_core.cli.reporters": ["heartbeat"],
        "fluxvla_core.contracts.reporter": ["Reporter", "SilentReporter"],
        "fluxvla_core.contracts.runner": ["Command"],
    },
)
