"""Alignment of the frames of a moving subject to one common time, by optical flow between tracking frames."""
