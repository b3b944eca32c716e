"""The options of `relit import`: one frozen model for each layout of files."""
