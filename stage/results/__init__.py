"""Result files: maps, depths, light bases and meshes, and what they record."""
