"""Policies that run in this process: loading one from a checkpoint, and inference."""
