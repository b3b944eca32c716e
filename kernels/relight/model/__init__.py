"""The reflectance model of solved maps under lights."""
