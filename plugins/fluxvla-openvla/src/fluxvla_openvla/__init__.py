"""OpenVLA and OpenVLA-OFT: models, transforms, and their published checkpoints."""
