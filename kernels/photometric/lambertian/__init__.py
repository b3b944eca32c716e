"""Least squares and robust fits of Lambert's law, and what their residuals tell."""
