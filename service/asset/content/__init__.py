"""Contents of an asset, independent of file formats: meshes, tangent frames, materials, texture images."""
