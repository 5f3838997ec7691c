"""Comparing forecasters and replays: intervals, paired tests, distances to closed loops."""
