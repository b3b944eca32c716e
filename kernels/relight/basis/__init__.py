"""Few coefficient images that stand for a capture."""
