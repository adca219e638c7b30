"""Evaluation: episodes in worker processes, results that do not depend on how many there were."""
