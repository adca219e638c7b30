"""Data-parallel training with a whole model on every process."""
