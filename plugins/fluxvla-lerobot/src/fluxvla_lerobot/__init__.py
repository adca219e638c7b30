"""Policies of an installed LeRobot as FluxVLA policies."""
