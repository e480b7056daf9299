"""What version 0.1 answers, written down before the rebuilding began, and compared ever since.

Goes once the rebuilding (the house, the front door) is over.

    python -m tests.record write          records what the stochfuse on the path answers
    python -m tests.record compare        compares, and says how many calls differ, and by how much
"""
