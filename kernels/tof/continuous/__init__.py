"""Continuous-wave time of flight: phases, unwrapping, noise and filters."""
