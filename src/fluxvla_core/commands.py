"""Public API for a plugin's own subcommands of ``fluxvla``: contract, progress, collection."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fluxvla_core import _lazy

if TYPE_CHECKING:
    from fluxvla_core.cli.data_commands import collect_demonstrations as collect_demonstrations
    from fluxvla_core.cli.reporters import heartbeat as heartbeat
    from fluxvla_core.cli.reporters import make_reporter as make_reporter
    from fluxvla_core.contracts.runner import Command as Command
    from fluxvla_core.contracts.runner import Reporter as Reporter
    from fluxvla_core.contracts.runner import SilentReporter as SilentReporter

__getattr__, __dir__, __all__ = _lazy.attach(__name__)
