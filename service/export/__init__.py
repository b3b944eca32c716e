"""Solved maps or a depth to an asset: reads them, chooses what is made of them, and hands it to the writer of the format."""
