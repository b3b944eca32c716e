"""Result files (maps, depths, light bases, meshes) and what they record; mattes, and the breaks and normals of depths."""
