"""Tiles of a board to one height map, its comparison with another, and what is significant."""
