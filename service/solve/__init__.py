"""Light-stage captures to normals, reflectance and height."""
