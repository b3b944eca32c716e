"""Captures and solved maps under new light."""
