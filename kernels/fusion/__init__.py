"""Range images of many views as one surface: a sparse truncated signed distance volume and the surface in it."""
