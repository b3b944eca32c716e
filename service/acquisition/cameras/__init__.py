"""Cameras that take pictures on request; a module for each kind."""
