"""`stochfuse links`: link probabilities from a packet log, from another file that people have, or of a scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stochfuse.cli.options import NETWORK, OUTPUT, SHOWN, Written, option
from stochfuse.cli.values import refuse, renamed, steps_at, tell

EXAMPLES = (
    "stochfuse links log.csv --plot links.png",
    "stochfuse links log.csv --nodes a,b,c --write network.toml",
    "stochfuse links road-5 --plot road.png",
)


def links(
    file: Annotated[
        str,
        typer.Argument(
            metavar="FILE",
            help="CSV or Parquet: a packet log, a Mercator or k7 file, an edge list or a matrix; or a scenario "
            "(.toml, .json, a preset).",
        ),
    ],
    columns: Annotated[
        str | None,
        option(
            "The file's names of columns: sender=src,receiver=dst; of seq, received, …", NETWORK, metavar="OURS=THEIRS"
        ),
    ] = None,
    nodes: Annotated[str | None, option("Only these nodes, in this order.", NETWORK, metavar="LIST")] = None,
    sent: Annotated[
        int | None, option("Packets behind each ratio of a k7 file that does not say.", NETWORK, min=1, metavar="N")
    ] = None,
    step: Annotated[
        float | None, option("Seconds in a step: delays from sent_time and received_time.", NETWORK, metavar="S")
    ] = None,
    at: Annotated[
        str | None,
        option("Steps of a scenario to show: 1,5,last; default: first, middle and last.", SHOWN, metavar="STEPS"),
    ] = None,
    write: Annotated[Path | None, option("Write a scenario's [network] there.", OUTPUT, metavar="FILE.toml")] = None,
    to: Written = Written(),
) -> None:
    """Show link probabilities with their 95 % intervals, asymmetry and memory, and what is unknown.

    Of a log of received packets alone, what was sent is taken from each sender's sequence numbers. Of a scenario:
    what its radio and places, its file or its matrix give.
    """
    from stochfuse.report.links import links_report, network_table
    from stochfuse.report.table import check_writable, write_text
    from stochfuse.scenario.known_links import is_scenario, links_of_scenario
    from stochfuse.scenario.links import read_links
    from stochfuse.scenario.scenario import load_scenario

    to.check(file)
    check_writable(write, (".toml",))
    steps = None
    if is_scenario(file):
        of_file = {"--columns": columns, "--sent": sent, "--step": step}
        refuse(of_file, "a file of links to go with it, got a scenario")
        scenario = load_scenario(file)
        found, steps = links_of_scenario(scenario), steps_at(at, scenario)
    else:
        refuse({"--at": at}, "a scenario to go with it, got a file of links")
        found = read_links(file, columns=renamed(columns, "OURS=THEIRS"), sent=sent, step=step)
    if nodes is not None:
        found = found.of([node.strip() for node in nodes.split(",")])
    tell(f"note: {note}" for note in found.notes)
    if found.unknown:
        some = ", ".join(f"{sender} to {receiver}" for receiver, sender in found.unknown[:5])
        more = f" and {len(found.unknown) - 5} more" if len(found.unknown) > 5 else ""
        tell([f"note: nothing is known of {some}{more}"])
    if write is not None:
        write_text(network_table(found), write)
    to.write(links_report(found, steps))
