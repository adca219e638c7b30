"""An example: a robot with a runner and an operator of its own."""
