"""Diffuse and specular materials: fits, mixtures, and what pixels share."""
