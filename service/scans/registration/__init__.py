"""Poses of scans: pairs by features and surfaces, then all at once with covariances."""
