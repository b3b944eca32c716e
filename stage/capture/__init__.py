"""Captures as their manifests describe them: cameras, projectors, lights, sequences."""
