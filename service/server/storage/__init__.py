"""Where captures and results lie: the data folder, or an object store."""
