"""Import of captures in other layouts: one module for each format, with `import_folder(source, destination)`."""
