"""An example: a training strategy of one's own."""
