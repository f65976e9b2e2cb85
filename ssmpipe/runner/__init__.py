"""Planning, caching, running and naming failures."""
