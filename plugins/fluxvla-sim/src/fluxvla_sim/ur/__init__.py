"""A UR5e with a Robotiq 2F-85 at a table with one cube."""
