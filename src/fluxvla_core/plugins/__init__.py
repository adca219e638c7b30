"""Plugins: found by metadata, loaded by name.

Only the index is imported here; ``plugins.registry`` brings the contracts with it, and a command
that lists what is installed needs none of them.
"""

from fluxvla_core.plugins._metadata import Index, Plugin, index

__all__ = ["Index", "Plugin", "index"]
