"""Assets: what they contain, and how each format is written."""
