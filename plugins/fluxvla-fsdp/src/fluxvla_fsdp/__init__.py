"""Fully sharded data-parallel training."""
