"""Forecasters: from the outputs so far, where the target is at the time of a query."""
