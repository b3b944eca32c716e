"""Plans of captures, and the pictures that they ask for."""
