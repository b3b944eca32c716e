"""Light keys, near lights, frame ranges and pictures, which several requests take."""
