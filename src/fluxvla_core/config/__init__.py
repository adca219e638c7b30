"""Configs: read, overridden, checked, written back. Nothing here imports a plugin."""
