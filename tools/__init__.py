"""What the nox sessions are made of: environments, wheels, the torch build, rendering, the demo.

These modules run under nox's own Python, before anything of the project is installed, so they use
the standard library alone.
"""
