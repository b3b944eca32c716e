"""Declare options, read them from a command line and record them."""
