"""Rigs of driven lamps, the levels of their primaries, and the DMX values that stand for them."""
