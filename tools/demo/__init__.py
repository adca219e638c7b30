"""The demo: from demonstrations of a scripted expert to an evaluated policy and its report.

Every step is a ``fluxvla`` command that a user could type; what is here is their order, their
sizes, and going on after an interruption.
"""
