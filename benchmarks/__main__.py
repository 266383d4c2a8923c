"""Speed as ratios measured in one run: `python -m benchmarks [NAME ...]` prints JSON lines.

Every `bench_NAME.py` beside this file has a function `run()` that yields one dictionary a row;
`name` and `ratio` are always among its keys. Nothing here is asserted: times belong to a machine.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path


def main(wanted: list[str]) -> int:
    """Run the named benchmarks (all by default) and print each row as one JSON line."""
    names = sorted(p.stem.removeprefix("bench_") for p in Path(__file__).parent.glob("bench_*.py"))
    unknown = sorted(set(wanted) - set(names))
    if unknown:
        print(f"unknown benchmark {', '.join(unknown)}; there are: {', '.join(names)}")
        return 2
    for name in wanted or names:
        for row in importlib.import_module(f"benchmarks.bench_{name}").run():
            print(json.dumps({"benchmark": name, **row}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
