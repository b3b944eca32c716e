"""Captures laid out another way → a manifest: one module a format, each with `import_folder(source, destination)`."""
