"""One thin file per stage; the registry finds them by file name."""
