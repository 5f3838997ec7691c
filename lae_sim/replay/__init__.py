"""Replaying recordings: under which world, with which processing times and boxes."""
