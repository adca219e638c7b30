"""Meta-World for FluxVLA: its 50 tasks as an environment, its scripted experts as a policy."""
