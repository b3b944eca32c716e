"""Checks of captures before they are worked on: admission of uploads, and relit info."""
