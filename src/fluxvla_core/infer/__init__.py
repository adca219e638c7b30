"""Policies on robots: loading one, and running it."""
