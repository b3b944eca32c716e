"""Posteriors over normals: from a reference object, or under extended sources."""
