"""The image stack of a capture: correction, ingest, alignment, and the readings of each pixel."""
