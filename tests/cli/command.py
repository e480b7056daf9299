"""The command line as tests type it: in this process where nothing else is said, which spares a second's start each."""

from __future__ import annotations

import json
import os
from contextlib import chdir, nullcontext
from types import SimpleNamespace

from typer.testing import CliRunner

from stochfuse.cli.app import app

ENV = {key: value for key, value in os.environ.items() if key not in ("COLUMNS", "FORCE_COLOR")}


def run(*arguments, code=0, env=None, input=None, cwd=None):
    """Run a command; what a process would give, and no traceback."""
    unset = {key: None for key in os.environ if key not in ENV}
    with chdir(cwd) if cwd else nullcontext():
        done = CliRunner().invoke(
            app, [str(word) for word in arguments], env={**unset, **(env or {})}, input=input, prog_name="stochfuse"
        )
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == code, done.stderr
    assert "internal error" not in done.stderr
    return SimpleNamespace(returncode=done.exit_code, stdout=done.stdout, stderr=done.stderr)


def strict_json(text):
    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)
