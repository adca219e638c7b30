"""GR00T N1.5 and N1.7 for FluxVLA: backbones, action head, published checkpoints."""
