"""Simulated robots behind the topics of the real ones."""
