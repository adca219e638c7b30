"""Conformance kits: subclass one in a plugin's tests and know that the plugin is right."""

from fluxvla_core.testing.environment import EnvironmentConformance
from fluxvla_core.testing.operator import OperatorConformance

__all__ = ["EnvironmentConformance", "OperatorConformance"]
