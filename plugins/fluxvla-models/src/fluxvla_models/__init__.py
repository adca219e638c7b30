"""Vision-Language-Action models, each composed from parts that a config names."""
