"""What every depth method returns, and its points."""
