"""How a command's help looks: examples first, options by panel, those that are rarely used only under --help-all."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import typer
from typer.core import TyperCommand

from stochfuse.cli.options import NETWORK, OUTPUT, RARE, SCENARIO, SHOWN, WORK

PANELS = ("Arguments", "Options", SCENARIO, NETWORK, SHOWN, WORK, OUTPUT)


class Command(TyperCommand):
    """A command whose help is grouped."""

    examples: Sequence[str] = ()

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Take --help-all, which no command has to declare."""
        if "--help-all" in args:
            ctx.meta["all"] = True
            typer.echo(self.get_help(ctx))
            ctx.exit()
        return super().parse_args(ctx, args)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write usage, examples, what it does, options."""
        self.format_usage(ctx, formatter)
        if self.examples:
            with formatter.section("Examples"):
                for example in self.examples:
                    formatter.write(f"{'':>{formatter.current_indent}}{example}\n")
        self.format_help_text(ctx, formatter)
        self.format_options(ctx, formatter)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the options by panel."""
        everything, left = ctx.meta.get("all", False), 0
        panels: dict[str, list[tuple[str, str]]] = {name: [] for name in PANELS}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is None:
                continue
            flags, text = record
            panel = getattr(parameter, "rich_help_panel", None)
            if panel is None:
                panel = "Arguments" if parameter.param_type_name == "argument" else "Options"
            if panel.endswith(RARE) and not everything:
                left += 1
                continue
            text = re.sub(r"\s+\[x>=[012]\]$", "", text)
            flags = flags.replace("  ", " ").replace(" <str>", "").replace(" <int>", " N").replace(" <float>", " X")
            panels[panel.removesuffix(RARE)].append((flags, text))
        if left:
            panels["Options"].append(("--help-all", f"Show {left} more options, which are rarely used, too."))
        for name, rows in panels.items():
            if rows:
                with formatter.section(name):
                    formatter.write_dl(rows, col_max=24)
