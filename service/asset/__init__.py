"""What an asset is made of before it has a file format: meshes, tangent frames and texture images of solved maps."""
