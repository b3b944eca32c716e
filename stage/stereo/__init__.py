"""Two cameras that see one scene: their geometry, the images that make their rows agree, and what matches say of it. NumPy only."""
