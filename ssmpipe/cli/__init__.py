"""The command line. Importing it loads click only; everything heavy is imported when a command runs."""

from ssmpipe.cli.root import main

__all__ = ["main"]
