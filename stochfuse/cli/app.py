"""The application: its commands, and what every command does with an error."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from stochfuse import __version__
from stochfuse.cli.help import Command
from stochfuse.cli.options import WORDS, gathered
from stochfuse.cli.progress import shown
from stochfuse.errors import NoAnswerError, ScenarioError, StochfuseError, UsageError, nearest

COMMANDS = (
    "predict",
    "compare",
    "solve",
    "messages",
    "derive",
    "graph",
    "run",
    "simulate",
    "crosscheck",
    "reproduce",
    "study",
    "explore",
    "links",
    "scenario",
    "methods",
    "explain",
    "doctor",
)
"""Each has a module in `stochfuse.cli`, with a function of the same name, or with an `app` of its own commands."""

WRONG_WORDS: type[Exception] = next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException")
"""What is raised for words that are no command line; Typer brings its own click, or uses the one that is installed."""
EXIT_FAILURE, EXIT_USAGE, EXIT_NO_ANSWER, EXIT_INTERRUPTED = 1, 2, 3, 130
START = """\
How good will the fused estimate be, as a function of the link probability?
  stochfuse predict                   a first table; --agents, --link, --steps and more change it
  stochfuse scenario new -o my.toml   a scenario of your own, with comments: stochfuse predict my.toml
  stochfuse solve --target 30         backwards: the link probability that a variance of 30 needs
  stochfuse --help                    all commands; stochfuse explain claimed: what a word means"""


def built(function: Any, name: str, examples: Any = ()) -> Any:
    """Return a function as a command with grouped options."""
    own = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    own.command(name, cls=Command)(gathered(function))
    command = typer.main.get_command(own)
    command.name, command.examples = name, examples  # type: ignore[attr-defined]
    return command


class Commands(TyperGroup):
    """Commands that are built when they are asked for; their errors become one message on stderr and an exit code."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names of the commands, in the order of the help."""
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Build one command."""
        if cmd_name not in COMMANDS:
            return None
        module = import_module(f"stochfuse.cli.{cmd_name}")
        own = getattr(module, "app", None)
        if own is not None:
            command = typer.main.get_command(own)
            command.name = cmd_name
            return command
        return built(getattr(module, cmd_name), cmd_name, getattr(module, "EXAMPLES", ()))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command, and name the nearest where there is none."""
        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            raise UsageError(f"no command '{args[0]}'{nearest(args[0], COMMANDS)}; commands: {', '.join(COMMANDS)}")
        return super().resolve_command(ctx, args)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Take --debug and --cite wherever they stand."""
        ctx.obj = "--debug" in args
        words = [word for word in args if word != "--debug"]
        WORDS.set(tuple(words))
        if "--cite" in words:
            from stochfuse.report.citations import cited

            typer.echo(cited(words), nl=False)
            ctx.exit()
        return super().parse_args(ctx, words)

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen command."""
        try:
            with shown():
                result = super().invoke(ctx)
            sys.stdout.flush()
            return result
        except NoAnswerError as error:
            _fail(f"no answer: {error}", EXIT_NO_ANSWER)
        except (ScenarioError, UsageError) as error:
            _fail(f"error: {error}", EXIT_USAGE)
        except StochfuseError as error:
            _fail(f"error: {error}", EXIT_FAILURE)
        except MemoryError:
            _fail("error: not enough memory; ask for fewer links, steps or agents at a time", EXIT_FAILURE)
        except BrokenPipeError:
            _silence()  # the reader has seen enough (`| head -1`)
            raise typer.Exit(0) from None
        except OSError as error:
            _silence()
            _fail(f"error: cannot write to standard output: {error.strerror or error}", EXIT_FAILURE)
        except KeyboardInterrupt:
            _fail("interrupted", EXIT_INTERRUPTED)
        except (typer.Exit, typer.Abort, WRONG_WORDS):
            raise
        except Exception as error:
            if ctx.obj:
                raise
            what = " ".join(f"{type(error).__name__}: {error}".split())
            _fail(f"internal error: {what}; --debug shows where", EXIT_FAILURE)


def _silence() -> None:
    """Keep the interpreter from complaining when it flushes what cannot be written any more."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(message: str, code: int) -> None:
    typer.echo(message, err=True)
    raise typer.Exit(code) from None


app = typer.Typer(
    cls=Commands,
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"stochfuse {__version__}")
        raise typer.Exit


@app.callback()
def options(
    ctx: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and stop.")
    ] = False,
    cite: Annotated[
        bool, typer.Option("--cite", help="Print BibTeX: this software, the thesis, and the --estimator's sources.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show where an internal error happened.")] = False,
) -> None:
    """How good will the fused estimate be, as a function of the link probability?

    Expected covariance of distributed Kalman fusion over links that lose messages, computed instead of simulated.
    """
    if ctx.invoked_subcommand is None:
        typer.echo(START)
