"""Exit codes of a run and of a projection."""

OK, INTERNAL, USAGE, QUARANTINED, IO_ERROR, LOCKED, INTERRUPTED = 0, 1, 2, 3, 74, 75, 130
