"""Cues sent to the lamps of a rig, frame by frame, over sACN or Art-Net."""
