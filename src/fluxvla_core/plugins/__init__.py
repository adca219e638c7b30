"""Plugins: found by the metadata of installed distributions, loaded by name."""
