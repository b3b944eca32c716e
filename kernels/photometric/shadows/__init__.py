"""Cast shadows, bounced light, and the parts of light sources that a pixel sees."""
