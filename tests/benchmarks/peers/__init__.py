"""The same work in FilterPy, Stone Soup, simdkalman and plain NumPy: `python -m tests.benchmarks.peers [--quick] [--markdown]`.

Agreement comes first: a run in which the answers differ ends with an error and shows no time at all.
"""
