"""The solution of every depth method, and what a capture needs to be triangulated."""
