"""Time of flight: raw frames, calibration tables, laser scans with their tracks, and a simulator of raw frames."""
