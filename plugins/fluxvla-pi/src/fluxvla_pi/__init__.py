"""PI0 and PI0.5: PaliGemma with a flow-matching action expert."""
