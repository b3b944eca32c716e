"""The mathematics of calibrations: arrays in, parameters with residuals out."""
