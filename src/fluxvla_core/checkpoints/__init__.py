"""Checkpoints: written so that a kill loses nothing, summed so that a flipped bit is found."""
