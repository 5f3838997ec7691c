"""Scores: which output answers which query, and how far the answers are from the truth."""
