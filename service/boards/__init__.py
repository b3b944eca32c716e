"""Inspection of boards: tiles to one height map, its comparison with a golden map or a design, and gauge studies."""
