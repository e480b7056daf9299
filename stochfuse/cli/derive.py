"""stub"""
def derive() -> None:
    """x."""
