"""Room profile."""
