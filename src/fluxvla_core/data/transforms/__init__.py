"""Transforms: what changes a sample between dataset and model, and actions on their way back."""
