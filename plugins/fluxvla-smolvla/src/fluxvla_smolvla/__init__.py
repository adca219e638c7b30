"""SmolVLA, a compact Vision-Language-Action model (Shukor et al. 2025, arXiv 2506.01844)."""
