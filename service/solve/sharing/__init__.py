"""The pieces of a solve over devices and workers."""
