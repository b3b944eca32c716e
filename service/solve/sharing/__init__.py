"""Batches of pixels over devices and workers, and the solution that they fill."""
