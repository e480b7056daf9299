"""The command line.  It only wires; what is heavy is imported inside the commands that need it.

`app` has the commands' names and what becomes of errors, `options` what several commands take, `values` how its texts
become values, `help` how it is shown, `progress` what is said while they work.  A new command is one file with a
function of its name and its EXAMPLES, and its name in `app.COMMANDS`; what it takes as others do are groups of
`options`.
"""

from __future__ import annotations

import sys
from io import TextIOWrapper


def main() -> None:
    """Run `stochfuse`; Ctrl-C ends it without a traceback at any moment, start-up included."""
    try:
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, TextIOWrapper):
                stream.reconfigure(errors="replace")
        if sys.stdout is None:
            sys.exit("error: standard output is closed")
        from stochfuse.cli.app import app

        app(prog_name="stochfuse")
    except OSError as error:  # --help and --version write before a command runs
        sys.stdout = None
        sys.exit(f"error: cannot write to standard output: {error.strerror or error}")
    except KeyboardInterrupt:
        _interrupted()
    except RuntimeError as error:
        # Python 3.11 wraps whatever happens while a class is being made
        if not isinstance(error.__cause__, KeyboardInterrupt):
            raise
        _interrupted()


def _interrupted() -> None:
    sys.stderr.write("interrupted\n")
    sys.exit(130)
