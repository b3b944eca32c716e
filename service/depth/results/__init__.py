"""The result of every depth method, and its points."""
