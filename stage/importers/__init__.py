"""Import of captures in other layouts: a module for each format or family of formats, whose `import_…` functions write a capture.json.

Every function that reads or writes a file raises StorageError where the file system refuses.
"""
