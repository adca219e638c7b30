"""Building blocks of the nox sessions: environments, wheels, the torch build, rendering, the demo.

These modules run under nox's own Python, before anything of the project is installed, so they use
the standard library alone.
"""
