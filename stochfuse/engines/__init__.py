"""Engines average an estimator over chance."""
