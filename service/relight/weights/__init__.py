"""Weights of captured lights: triangulation and kernel quadrature."""
