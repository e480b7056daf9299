"""A one-command Typer application, for the comparison of start-up times."""

import typer

app = typer.Typer()


@app.command()
def main(name: str = "world") -> None:
    """Greet."""
    typer.echo(f"hello {name}")


if __name__ == "__main__":
    app()
