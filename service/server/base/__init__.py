"""What every part of the server uses: settings, log, traces, names and locks."""
