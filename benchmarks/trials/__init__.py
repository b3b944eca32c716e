"""Scenes on which confidence and σ are judged, a file for each way of measuring. Each file has `trials(data)`, which yields them."""
