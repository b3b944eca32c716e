"""Settings, log, traces, names, locks and threads, which every part of the server uses."""
