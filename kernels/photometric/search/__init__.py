"""The search of normals by hypotheses, and how certain its results are."""
