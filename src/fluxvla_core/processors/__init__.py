"""Tokenizers, and where pretrained files are found."""
