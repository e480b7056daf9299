"""Measure the peers beside stochfuse, in one run on one thread; extra `bench`."""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys

PEERS = ("filterpy", "stonesoup", "simdkalman")
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.peers", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few items, one round: only that it runs and agrees")
    parser.add_argument("--markdown", action="store_true", help="print the table for the README")
    given = parser.parse_args()
    missing = [name for name in PEERS if importlib.util.find_spec(name) is None]
    if missing:
        print(f"peers: not installed: {', '.join(missing)}; they come with: pip install '.[bench]'", file=sys.stderr)
        return 2
    os.environ.update(dict.fromkeys(THREADS, "1"))  # NumPy's libraries read them when they are loaded, so before
    from tests.benchmarks.peers.report import report

    report(quick=given.quick, markdown=given.markdown)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
