"""Assets as binary glTF."""
