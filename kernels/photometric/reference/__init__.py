"""Normals from a reference object: posteriors over directions."""
