"""Hypothesis: the same examples in every run, no deadline on a loaded machine."""

from hypothesis import settings

settings.register_profile("stochfuse", deadline=None, derandomize=True, max_examples=40)
settings.load_profile("stochfuse")
