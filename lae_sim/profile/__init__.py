"""Profiling: running a live tracker under the engine's virtual clock, on this device."""
