"""What an asset is made of, without a file format: meshes, tangent frames, materials, texture images."""
