"""Room importers."""
