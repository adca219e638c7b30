"""Checkpoints: written atomically, so that a kill loses nothing; SHA-256 finds a flipped bit."""
