"""Studies: what was trained and tested, and what runs it. `registry.get(name)` finds one."""
