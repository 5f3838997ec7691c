"""Forecasters by name, and the training of those that learn, across folds of the sequences."""
