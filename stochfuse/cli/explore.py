"""`stochfuse explore`: the page in a browser."""

from __future__ import annotations

from typing import Annotated

import typer

from stochfuse.cli.options import OUTPUT, RARE, ScenarioArgument, option
from stochfuse.cli.progress import quiet

EXAMPLES = ("stochfuse explore my.toml", "stochfuse explore my.toml --port 5010 --no-browser")


def explore(
    scenario: ScenarioArgument = "thesis-transient",
    port: Annotated[
        int | None,
        option("Port of the page; default: the first free one from 5006.", OUTPUT, min=1, max=65535, metavar="N"),
    ] = None,
    no_browser: Annotated[bool, option("Only say the page's address.", OUTPUT, "--no-browser")] = False,
    address: Annotated[
        str, option("Address of this machine to listen on; default: 127.0.0.1.", OUTPUT + RARE, metavar="ADDRESS")
    ] = "127.0.0.1",
) -> None:
    """Open a page in the browser: move a number, and see what it does to the error.

    Only this machine can open the page, unless --address says another. Ctrl-C ends it.
    """
    from stochfuse.explore.serve import serve
    from stochfuse.explore.state import begun

    given = begun(scenario)

    def started(url: str) -> None:
        typer.echo(f"{url}   (Ctrl-C ends)", err=True)
        if not no_browser:
            import webbrowser

            webbrowser.open(url)

    quiet()
    serve(given, port, address, started)
