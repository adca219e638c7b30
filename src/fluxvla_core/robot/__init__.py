"""Policies on robots: the episode engine, its safety, and recordings of what happened."""
