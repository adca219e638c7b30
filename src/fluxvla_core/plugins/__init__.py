"""Plugins: found by metadata, loaded by name."""

from fluxvla_core.plugins._metadata import Index, Plugin, index
from fluxvla_core.plugins.registry import BY_NAME, Registry

__all__ = ["BY_NAME", "Index", "Plugin", "Registry", "index"]
