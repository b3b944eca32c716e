"""The command line, one module for each group of commands. Heavy imports stand inside commands, so that the program starts fast."""
