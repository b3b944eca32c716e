"""What a run says about itself: its progress, and where its results came from."""
