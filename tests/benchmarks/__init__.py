"""Speed and accuracy as ratios measured in one run: `python -m tests.benchmarks [--quick]`."""
