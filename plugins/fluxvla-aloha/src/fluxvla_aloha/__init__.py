"""FluxVLA on ALOHA."""
