"""USD assets from solved maps: the only place with pxr."""
