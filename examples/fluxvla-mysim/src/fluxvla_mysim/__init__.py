"""An example: an evaluation in a simulation of one's own."""
