"""Fusion of estimates and measurements, one rule a file: pure functions over stacks of arrays, no network.

The estimators (`stochfuse.estimators.protocol`) carry these rules over lossy links.
"""
