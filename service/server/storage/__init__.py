"""Storage of captures and results: the data folder, or an object store."""
