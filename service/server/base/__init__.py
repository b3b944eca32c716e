"""Settings, log, traces, names and locks, which every part of the server uses."""
