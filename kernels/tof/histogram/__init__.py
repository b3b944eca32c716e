"""Pulsed time of flight: photon histograms, returns and pile-up."""
