"""A one-command Typer application that imports numpy and prints one rich table."""

import typer

app = typer.Typer()


@app.command()
def main(name: str = "world") -> None:
    """Print a table."""
    import numpy as np
    from rich.console import Console
    from rich.table import Table

    table = Table("name", "k=1", "k=2")
    for value in np.linspace(0, 1, 5):
        table.add_row(name, f"{value:.3f}", f"{value**2:.3f}")
    Console().print(table)


if __name__ == "__main__":
    app()
