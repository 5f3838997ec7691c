"""Studies: many traces in many worlds, computed once per cell, on all cores or a cluster."""
