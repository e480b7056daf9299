"""Questions asked backwards: which link probability, which link, how many agents."""
