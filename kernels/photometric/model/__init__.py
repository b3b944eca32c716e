"""Reflectance models and the readings that they are compared with."""
