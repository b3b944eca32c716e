"""Time of flight: correlation images and histograms in, ranges and their uncertainty out."""
