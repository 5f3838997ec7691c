"""Room replay."""
