"""LIBERO for FluxVLA: evaluation, inference, and demonstrations of a scripted expert."""
