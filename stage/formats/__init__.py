"""Image, array and point files: how each format is read and written."""
