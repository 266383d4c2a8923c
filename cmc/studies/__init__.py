"""Studies: a frozen configuration, `train`, `evaluate` and `load` each."""
