"""Data-parallel training with a full copy of the model on every process."""
