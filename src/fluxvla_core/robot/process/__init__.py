"""The control process of a robot: sends commands and reads the state, apart from the policy."""
