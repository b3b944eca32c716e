"""The shipped sample, worked on and shown; and the speed of this machine."""
