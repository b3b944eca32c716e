"""Manifests of several captures: scan sets and boards."""
