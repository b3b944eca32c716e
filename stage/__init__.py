"""The domain: captures and their manifests, cameras and lights, pixels, and the files of results; NumPy, without Warp."""
