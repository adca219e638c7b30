"""Any Gymnasium environment for FluxVLA: evaluation and collection from a config."""
