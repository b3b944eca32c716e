"""Surface from normals: heights, and what one part of a surface hides from another."""
