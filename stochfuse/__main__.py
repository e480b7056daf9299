"""`python -m stochfuse`."""

from stochfuse.cli import main

main()
