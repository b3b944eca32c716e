"""Mathematics on arrays, in Warp and NumPy: arrays in, arrays and a status per pixel out; no files, no web."""
