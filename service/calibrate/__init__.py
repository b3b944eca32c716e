"""Calibration of captures from images of targets: lights, sensor, projector, time-of-flight camera."""
