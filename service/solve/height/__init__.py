"""Heights of solved normals: parts, distances, and the light that a surface hides or throws on itself."""
