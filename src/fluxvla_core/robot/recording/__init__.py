"""Recordings of episodes: writing, reading back, replaying, turning into a dataset."""
