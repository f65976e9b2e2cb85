"""What is done with a finished model: load it, draw from it, export it, compare groups, take in new patients."""
