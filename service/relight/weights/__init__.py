"""Weights of captured lights: triangulations, quadrature and environments."""
