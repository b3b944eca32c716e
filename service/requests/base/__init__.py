"""How options are declared, read from a command line and recorded."""
