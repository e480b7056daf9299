"""`stochfuse messages`."""

from __future__ import annotations


def messages() -> None:
    """To come."""
