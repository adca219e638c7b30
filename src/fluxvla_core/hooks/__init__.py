"""Lifecycle observers, active only where a config names them."""

from fluxvla_core.hooks.manager import HookCaller, build_hooks

__all__ = ["HookCaller", "build_hooks"]
