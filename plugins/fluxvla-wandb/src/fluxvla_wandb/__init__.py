"""Videos and success rates in Weights & Biases (https://wandb.ai), online and offline."""
