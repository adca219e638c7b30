"""What happens to a sample between the dataset and the model, and back."""
