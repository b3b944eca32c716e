"""Weights of captured lights that stand for an environment."""
