"""Configs: read, overridden, checked, written back. Nothing here imports a plugin."""

from fluxvla_core.config.check import Checked, check_config, examine
from fluxvla_core.config.frozen import freeze, thaw
from fluxvla_core.config.load import load_config
from fluxvla_core.config.overrides import apply_overrides
from fluxvla_core.config.resolved import environment, write_resolved
from fluxvla_core.config.tree import Config

__all__ = [
    "Checked",
    "Config",
    "apply_overrides",
    "check_config",
    "environment",
    "examine",
    "freeze",
    "load_config",
    "thaw",
    "write_resolved",
]
