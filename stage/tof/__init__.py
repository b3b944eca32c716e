"""Time of flight as files and devices give it: raw frames, calibration tables, shots and tracks, and a simulator."""
