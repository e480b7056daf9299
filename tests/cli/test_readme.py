"""Everything that README and handbook show is run, and what it prints must be what they print.

`python -m tests.cli.test_readme` writes the outputs into them after a change that was looked at.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from tests.cli.command import run
from tests.handbook import HANDBOOK, PAGES

README = Path(__file__).parents[2] / "README.md"
DOCUMENTS = [README, *sorted(HANDBOOK.glob("*.md"))]
CONSOLE = re.compile(r"```console\n(.*?)```", re.DOTALL)


def commands(block):
    """The commands of a block, each with the output printed under it."""
    found = []
    for line in block.splitlines():
        if line.startswith("$ "):
            found.append((line[2:], []))
        else:
            found[-1][1].append(line)
    return [(command, "\n".join(output).strip("\n")) for command, output in found]


def everything():
    return "\n".join(document.read_text(encoding="utf-8") for document in DOCUMENTS)


def shown():
    return [c for block in CONSOLE.findall(everything()) for c in commands(block)]


SHELL = re.compile(r"[|<>;]|^(?!stochfuse )")


def execute(command, folder):
    """Run a command: in this process, which spares its start, or by a shell where it takes one."""
    if not SHELL.search(command):
        return run(*shlex.split(command)[1:], cwd=folder, env={"COLUMNS": "80"}).stdout.strip("\n")
    env = {**os.environ, "COLUMNS": "80", "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(command, shell=True, cwd=folder, capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip("\n")


def files(folder):
    """Write the files that are shown, whose first line is their name in a comment."""
    text = everything()
    for content, name in re.findall(r"```toml\n(# (\S+\.toml)\n.*?)```", text, re.DOTALL):
        (folder / name).write_text(content)
    for content, name in re.findall(r"```py\n(# (\S+\.py)\n.*?)```", text, re.DOTALL):
        (folder / name).write_text(content)
    for rules in HANDBOOK.glob("*.py"):
        (folder / rules.name).write_text(rules.read_text(encoding="utf-8"))
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return files(tmp_path_factory.mktemp("readme"))


@pytest.mark.slow
@pytest.mark.parametrize(("command", "output"), shown(), ids=[c for c, _ in shown()])
def test_console_examples(command, output, folder):
    assert execute(command, folder) == output


PYTHON = re.compile(r"```python\n(.*?)```(?:\n\n```text\n(.*?)```)?", re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize(("code", "output"), PYTHON.findall(everything()))
def test_python_example(code, output, tmp_path):
    (tmp_path / "example.py").write_text(code)
    printed = execute(f"{sys.executable} example.py", tmp_path)
    if output:
        assert printed == output.strip("\n")
    else:
        assert "thesis-transient: 3 agents, ad-hoc; every agent alike" in printed


def test_scenario_example_is_valid(tmp_path):
    (text,) = re.findall(r"```toml\n(?!# )(.*?)```", everything(), re.DOTALL)
    (tmp_path / "mine.toml").write_text(text)
    assert "ok: 3 agents with 2 kinds of sensors" in execute("stochfuse scenario check mine.toml", tmp_path)
    assert "RMS of position [m]" in execute("stochfuse predict mine.toml --metric rms:position", tmp_path)


def test_the_two_set_up_commands_are_one_line_each():
    lines = [line for line in README.read_text(encoding="utf-8").splitlines() if line.startswith("python3 -m venv")]
    assert len(lines) == 2
    assert lines[0].endswith("stochfuse predict")
    assert lines[1].endswith("-m pytest")


def test_the_readme_is_short():
    text = README.read_text(encoding="utf-8")
    assert text.count("\n") <= 250
    assert len(text.encode()) <= 14_000


def test_links_between_documents_lead_somewhere():
    for document in DOCUMENTS:
        for target in re.findall(r"\]\(([^)#:]+)\)", document.read_text(encoding="utf-8")):
            assert (document.parent / target).exists(), (document.name, target)


@pytest.mark.parametrize("name", PAGES)
def test_generated_pages_are_current(name):
    assert (HANDBOOK / name).read_text(encoding="utf-8") == PAGES[name](), "python -m tests.handbook writes it"


def rewrite():
    def fill(match):
        lines = []
        for command, _ in commands(match.group(1)):
            lines.append(f"$ {command}\n{execute(command, folder)}".strip("\n"))
        return "```console\n" + "\n\n".join(lines) + "\n```"

    with tempfile.TemporaryDirectory() as made:
        folder = files(Path(made))
        for document in DOCUMENTS:
            document.write_text(CONSOLE.sub(fill, document.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    rewrite()
