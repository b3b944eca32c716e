"""The domain: what was captured, by what, in which units. NumPy only; no Warp."""
