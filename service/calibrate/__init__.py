"""Images of targets to calibrated captures."""
