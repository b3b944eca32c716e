"""relit demo on the shipped sample, its preview image, and relit bench."""
