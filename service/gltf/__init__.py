"""Assets as binary glTF (.glb)."""
