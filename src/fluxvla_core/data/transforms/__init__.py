"""Transforms of samples between dataset and model, and of actions between model and robot."""
