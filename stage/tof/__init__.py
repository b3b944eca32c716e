"""Time of flight: raw frames, calibration tables, laser scans with their tracks, and a simulator of raw frames.

Every function that reads or writes a file raises StorageError where the file system refuses.
"""
