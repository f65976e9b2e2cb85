"""How good a model and its correspondence are."""
