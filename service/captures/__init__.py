"""Captures looked at before they are worked on."""
