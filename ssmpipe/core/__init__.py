"""Pure mathematics on arrays: no files, no command line, no configuration, no global random state."""
