"""Studies that are killed, interrupted, run out of disk or lose workers, for real: the result is that of a quiet run."""

from __future__ import annotations

import gc
import itertools
import os
import random
import re
import resource
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

import stochfuse as sf
from stochfuse.cli import main
from stochfuse.cli import study as cli
from stochfuse.studies import reading, running
from tests.cli.command import run

AGAIN = "finished points are kept: the same command goes on"
SCENARIO = """
[scenario.model]
F = 1.0
H = 1.0
Q = 1.0
R = 1.0
[scenario.initial]
P = 1.0
[scenario.network]
agents = 3
steps = 3
"""
# fifteen chunks of four points, each some hundredths of a second
SAMPLED = f"""{SCENARIO}
[vary]
"network.link" = {{ from = 0, to = 1, number = 10 }}
"model.R" = [1.0, 2.0, 0.0, 4.0, 5.0, 6.0]
[predict]
method = "monte-carlo"
runs = 100
"""
PRECISE = SAMPLED.replace("runs = 100", "precision = 0.05")
# quick to work out, and long to write
LARGE = f"""{SCENARIO}
[vary]
"network.link" = {{ from = 0, to = 1, number = 20000 }}
"""

STUDIES = {"sampled": SAMPLED, "large": LARGE}


def command(study: Path, *options: str) -> list[str]:
    return [sys.executable, "-m", "stochfuse", "study", str(study), *options]


def start(study: Path, *options: str) -> subprocess.Popen[str]:
    """Start the command in a process group of its own, as a terminal does."""
    return subprocess.Popen(
        command(study, *options),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        cwd=study.parent,
    )


def descendants(pid: int) -> set[int]:
    """Processes that a process has started, and those that they have."""
    parents = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            except (FileNotFoundError, ProcessLookupError):
                continue
    found, new = set(), {pid}
    while new:
        new = {child for child, parent in parents.items() if parent in new}
        found |= new
    return found


def alive(pid: int) -> bool:
    """Whether a process is there, and no corpse."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def wait_until(condition, seconds: float) -> bool:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True


def content(path: Path) -> object:
    """The rows: of a CSV file its bytes."""
    return pq.read_table(path).to_pylist() if path.suffix == ".parquet" else path.read_bytes()


def parts(output: Path) -> dict[str, bytes]:
    folder = output.with_name(f"{output.name}.parts")
    return {path.name: path.read_bytes() for path in folder.glob("part-*")}


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    """The results of uninterrupted runs, by study and ending."""
    folder = tmp_path_factory.mktemp("quiet")
    found = {}
    for name, suffix in itertools.product(STUDIES, (".csv", ".parquet")):
        study = folder / f"{name}.toml"
        study.write_text(STUDIES[name])
        began = time.monotonic()
        sf.study(study, study.with_suffix(suffix))
        found[name, suffix] = (content(study.with_suffix(suffix)), time.monotonic() - began)
    return found


def the_command(arguments: list[str], log: str) -> None:
    """Be the command: what a process forked for it does."""
    os.setsid()
    with open(log, "w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    sys.argv = ["stochfuse", "study", *arguments]
    main()


def launch(forked: Any, study: Path, arguments: list[str], log: Path) -> Any:
    """Start the command: a fork that has read the libraries already, or a process from nothing."""
    if forked is None:
        with log.open("w") as file:
            return subprocess.Popen(command(study, *arguments), stdout=file, stderr=file)
    process = forked(target=the_command, args=([str(study), *arguments], str(log)))
    process.start()
    return process


@pytest.fixture(scope="module")
def forked():
    """Processes that have read the libraries already: there are more kills in a minute."""
    context = get_context("forkserver")
    context.set_forkserver_preload(["stochfuse.cli.study", "stochfuse.studies.running", "pyarrow.parquet"])
    warm = context.Process(target=int)
    warm.start()
    warm.join()
    return context.Process


ROUNDS = [
    ("sampled", ".csv", "1", 3),
    ("sampled", ".parquet", "2", 2),
    ("large", ".csv", "1", 2),
    *(
        pytest.param(*case, marks=pytest.mark.slow)
        for case in [
            ("sampled", ".csv", "1", 6),
            ("sampled", ".parquet", "1", 6),
            ("sampled", ".parquet", "2", 6),
            ("large", ".csv", "1", 6),
        ]
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "suffix", "workers", "rounds"), ROUNDS)
def test_kills_at_random_moments(name, suffix, workers, rounds, tmp_path, quiet, forked):
    expected, seconds = quiet[name, suffix]
    study, output, log = tmp_path / "mine.toml", tmp_path / f"mine{suffix}", tmp_path / "log"
    study.write_text(STUDIES[name])
    moment = random.Random(f"{name}{suffix}{workers}")
    arguments = ["-o", str(output), "--workers", workers]
    folder = output.with_name(f"{output.name}.parts")
    log.touch()
    kept: dict[str, bytes] = {}
    for _ in range(rounds):
        process = launch(forked if workers == "1" else None, study, arguments, log)
        if moment.random() < 0.7:
            # most of the time it begins, and little of what is of interest happens
            assert wait_until(lambda: folder.exists() or output.exists(), 30), log.read_text()
        time.sleep(moment.uniform(0.0, 0.5 * seconds + (int(workers) - 1)))
        theirs = descendants(process.pid)
        moment.choice((process.kill, process.terminate))()
        (process.join if workers == "1" else process.wait)()
        assert wait_until(lambda theirs=theirs: not any(map(alive, theirs)), 10), "workers stay behind"
        # Python's tracker of what was left behind is one of them, and need say nothing either
        assert not re.search("Traceback|Warning|leaked", log.read_text())
        found = parts(output)
        assert output.exists() or kept.items() <= found.items()
        kept = found
    done = subprocess.run(command(study, "-o", str(output)), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert content(output) == expected
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["log", output.name, f"{output.name}.study.json", "mine.toml"]


@pytest.mark.parametrize("workers", ["1", pytest.param("2", marks=pytest.mark.slow)])
def test_ctrl_c_ends_it_and_says_what_is_kept(workers, tmp_path, quiet):
    study, output = tmp_path / "mine.toml", tmp_path / "mine.csv"
    study.write_text(SAMPLED)
    process = start(study, "-o", str(output), "--workers", workers)
    assert wait_until(lambda: parts(output), 30)
    theirs = descendants(process.pid)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert out == ""
    assert err.splitlines()[-2:] == [f"note: {AGAIN}", "interrupted"]
    assert "Traceback" not in err
    assert wait_until(lambda: not any(map(alive, theirs)), 10)
    assert parts(output)
    again = sf.study(study, output, workers=int(workers))
    assert content(output) == quiet["sampled", ".csv"][0]
    assert again.failed == 10


def test_ctrl_c_while_workers_start(tmp_path):
    study, output = tmp_path / "mine.toml", tmp_path / "mine.csv"
    study.write_text(SAMPLED)
    process = start(study, "-o", str(output), "--workers", "2")
    assert wait_until(lambda: len(descendants(process.pid)) >= 2, 30)
    time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert (process.returncode, "Traceback" in err) == (130, False), err


@pytest.mark.slow
def test_two_commands_at_once(tmp_path, quiet):
    study, output = tmp_path / "mine.toml", tmp_path / "mine.csv"
    study.write_text(SAMPLED)
    process = start(study, "-o", str(output))
    assert wait_until(lambda: parts(output), 30)
    with pytest.raises(sf.UsageError, match=r"another process is working on .*mine\.csv\.parts"):
        sf.study(study, output)
    process.communicate(timeout=60)
    assert process.returncode == 0
    assert content(output) == quiet["sampled", ".csv"][0]


LIMITS = {"a part": 100_000, "the result": 550_000}
"""Bytes that a file may have: the first part has more; all parts have less, and the result more."""


@pytest.mark.parametrize(
    ("suffix", "limit"),
    [(".csv", "a part"), (".csv", "the result"), pytest.param(".parquet", "the result", marks=pytest.mark.slow)],
)
def test_a_file_that_may_not_grow(suffix, limit, tmp_path, quiet):
    """The system refuses writes inside pyarrow and csv alike, as a full disk does."""
    study, output = tmp_path / "mine.toml", tmp_path / f"mine{suffix}"
    study.write_text(LARGE)
    most = LIMITS[limit]
    done = subprocess.run(
        command(study, "-o", str(output)),
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (most, most)),
    )
    assert done.returncode == 2, done.stderr
    where = "part-00000000" if limit == "a part" else f"mine{re.escape(suffix)}"
    assert re.fullmatch(f"error: cannot write .*{where}: .*File too large.*; {AGAIN}\n", done.stderr), done.stderr
    assert not output.exists()
    assert len(parts(output)) == (0 if limit == "a part" else 2)
    sf.study(study, output)
    assert content(output) == quiet["large", suffix][0]


SMALL_DISK = """
mount -t tmpfs -o size=1000k none disk && cp mine.toml disk && cd disk || exit 99
{command} -o mine{suffix}
echo "exit $?, $(ls -A mine{suffix}.parts | wc -l) files"
mount -o remount,size=64m . && {command} -o mine{suffix} >&2 && cp mine{suffix} ..
"""


@pytest.mark.slow
@pytest.mark.skipif(
    subprocess.run(["unshare", "-rm", "mount", "-t", "tmpfs", "none", "/mnt"], capture_output=True).returncode != 0,
    reason="no disk can be mounted here",
)
@pytest.mark.parametrize("suffix", [".parquet"])
def test_a_disk_that_is_full(suffix, tmp_path, quiet):
    study = tmp_path / "mine.toml"
    study.write_text(LARGE)
    (tmp_path / "disk").mkdir()
    script = SMALL_DISK.format(command=f"{sys.executable} -m stochfuse study mine.toml", suffix=suffix)
    done = subprocess.run(
        ["unshare", "-rm", "sh", "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    # lock, record and both parts stay
    assert done.stdout == "exit 2, 4 files\n", done.stderr
    assert re.match(f"error: cannot write mine{suffix}: .*No space left on device.*; {AGAIN}\n", done.stderr)
    assert content(tmp_path / f"mine{suffix}") == quiet["large", suffix][0]


FEW = {
    "scenario": {
        "model": {"F": 1.0, "H": 1.0, "Q": 1.0, "R": 1.0},
        "initial": {"P": 1.0},
        "network": {"agents": 3, "steps": 2},
    },
    "vary": {"network.link": [0.0, 0.25, 0.5, 0.75, 1.0, 2.0], "model.R": [1.0, 2.0, 3.0, 4.0]},
    "predict": {"method": "monte-carlo", "runs": 10},
}


@pytest.fixture(scope="module")
def few(tmp_path_factory):
    output = tmp_path_factory.mktemp("few") / "few.csv"
    assert sf.study(FEW, output).failed == 4
    return output.read_bytes()


@pytest.mark.slow
def test_any_executor_does_the_work(tmp_path, few):
    with ThreadPoolExecutor(2) as threads:
        sf.study(FEW, tmp_path / "threads.csv", executor=threads)
    assert (tmp_path / "threads.csv").read_bytes() == few
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as processes:
        sf.study(FEW, tmp_path / "processes.csv", executor=processes)
    assert (tmp_path / "processes.csv").read_bytes() == few


def dies_at_the_end(record: str, chunk: int) -> tuple[bytes, dict[str, str]]:
    """Stand in for `running.answer`: its last chunk takes the worker with it, as the system does when memory is out."""
    if chunk == 5:
        os.kill(os.getpid(), signal.SIGKILL)
    return running.answer(record, chunk)


def dies_once(record: str, chunk: int) -> tuple[bytes, dict[str, str]]:
    """The same the first time only."""
    place = Path(os.environ["STOCHFUSE_TEST_DIED"])
    if chunk == 2 and not place.exists():
        place.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return running.answer(record, chunk)


class Handing:
    """Hands out another function than the one that is asked for."""

    def __init__(self, function, pool):
        self.function, self.pool = function, pool

    def __call__(self, *rest, **named):
        return Handing(self.function, self.pool(*rest, **named))

    def submit(self, _, *rest):
        return self.pool.submit(self.function, *rest)

    def shutdown(self, **named):
        self.pool.shutdown(**named)


@pytest.mark.slow
def test_a_chunk_that_kills_its_worker_every_time_is_named(tmp_path, few, monkeypatch):
    output = tmp_path / "few.csv"
    message = "^a worker died at points 20 to 23, again when it was alone with them; what is finished is kept$"
    with monkeypatch.context() as patched:
        patched.setattr(running, "ProcessPoolExecutor", Handing(dies_at_the_end, ProcessPoolExecutor))
        with pytest.raises(sf.StochfuseError, match=message):
            sf.study(FEW, output, workers=2)
    assert set(parts(output)) == {f"part-{chunk:08d}" for chunk in range(5)}
    sf.study(FEW, output)
    assert output.read_bytes() == few


@pytest.mark.slow
def test_a_worker_that_dies_once_is_replaced(tmp_path, few, monkeypatch):
    monkeypatch.setenv("STOCHFUSE_TEST_DIED", str(tmp_path / "died"))
    monkeypatch.setattr(running, "ProcessPoolExecutor", Handing(dies_once, ProcessPoolExecutor))
    sf.study(FEW, tmp_path / "few.csv", workers=2)
    assert (tmp_path / "died").exists()
    assert (tmp_path / "few.csv").read_bytes() == few


def test_a_given_executor_that_breaks_is_not_mended(tmp_path, few):
    output = tmp_path / "few.csv"
    message = rf"^a worker died \(.*\); {AGAIN}$"
    with (
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool,
        pytest.raises(sf.StochfuseError, match=message),
    ):
        sf.study(FEW, output, executor=Handing(dies_at_the_end, pool))  # type: ignore[arg-type]
    sf.study(FEW, output)
    assert output.read_bytes() == few


def other_software(record: str, chunk: int) -> tuple[bytes, dict[str, str]]:
    return b"", {**reading.software(), "numpy": "1.0"}


def fails(record: str, chunk: int) -> tuple[bytes, dict[str, str]]:
    raise RuntimeError("no such thing\nin two lines")


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (other_software, r"workers: expected the same software as here, got numpy 1\.0 instead of [0-9.]+$"),
        (fails, rf"a worker failed \(RuntimeError: no such thing\); {AGAIN}"),
    ],
)
def test_workers_that_are_not_as_they_should_be(function, message, tmp_path):
    with ThreadPoolExecutor(1) as threads, pytest.raises(sf.StochfuseError, match=message):
        sf.study(FEW, tmp_path / "few.csv", executor=Handing(function, threads))  # type: ignore[arg-type]


@contextmanager
def local_cluster(workers: int):
    """Workers, each a process, on the loopback."""
    from dask import config
    from distributed import LocalCluster

    quiet_please = {
        "distributed.logging.distributed": "critical",
        "distributed.admin.system-monitor.gil.enabled": False,
    }
    with (
        config.set(quiet_please),
        LocalCluster(
            n_workers=workers,
            processes=True,
            threads_per_worker=1,
            host="127.0.0.1",
            dashboard_address=":0",
            silence_logs=50,
        ) as cluster,
    ):
        yield cluster


@pytest.fixture(scope="module")
def cluster():
    with local_cluster(2) as cluster:
        yield cluster


@pytest.fixture
def collected():
    """Let clients that failed to connect go at once: Dask waits forever for one that goes while another starts."""
    yield
    gc.collect()


@pytest.mark.slow
def test_a_dask_cluster_of_two_workers_one_of_which_is_killed(cluster, tmp_path, quiet, collected):
    assert with_one_killed(cluster, 2, tmp_path) == quiet["sampled", ".csv"][0]


@pytest.mark.slow
def test_a_dask_cluster_of_four_workers_one_of_which_is_killed(tmp_path, quiet, collected):
    """Points that draw until a precision is reached, each as many runs as alone."""
    alone = tmp_path / "alone.csv"
    (tmp_path / "alone.toml").write_text(PRECISE)
    sf.study(tmp_path / "alone.toml", alone)
    with local_cluster(4) as four:
        assert with_one_killed(four, 4, tmp_path, PRECISE) == content(alone)


def with_one_killed(cluster, workers, tmp_path, text=SAMPLED):
    """What a study of sampled points writes on a cluster of which a worker is killed after the first chunk."""
    from distributed import Client

    study, output = tmp_path / "mine.toml", tmp_path / "mine.csv"
    study.write_text(text)
    client: Any = Client(cluster)
    with client:
        client.wait_for_workers(workers, timeout=20)
        victim = sorted(client.run(os.getpid).values())[0]
        killed = []

        class KillsOne(running.StudyProgress):
            def advance(self, points: int) -> None:
                if not killed:
                    os.kill(victim, signal.SIGKILL)
                    killed.append(len(parts(output)))

        sf.study(study, output, executor=client.get_executor(), workers=workers, progress=KillsOne())
        assert killed == [1]
        assert not alive(victim)
    return content(output)


@pytest.mark.slow
def test_the_command_works_on_a_dask_cluster(cluster, tmp_path, quiet, collected):
    study, output = tmp_path / "mine.toml", tmp_path / "mine.parquet"
    study.write_text(SAMPLED)
    done = run("study", study, "-o", output, "--dask", cluster.scheduler_address)
    assert done.stderr == (
        "warning: 10 of 60 points failed; the first, point 2: model.R: expected a "
        "symmetric positive definite matrix, got a variance of 0 on the diagonal\n"
    )
    assert content(output) == quiet["sampled", ".parquet"][0]


def test_a_dask_scheduler_that_does_not_answer(tmp_path, monkeypatch, collected):
    monkeypatch.setattr(cli, "PATIENCE", 0.5)
    study = tmp_path / "mine.toml"
    study.write_text(SAMPLED)
    began = time.monotonic()
    done = run("study", study, "--dask", "tcp://127.0.0.1:9", code=2)
    assert time.monotonic() - began < 15
    assert "error: --dask tcp://127.0.0.1:9: expected a Dask scheduler that answers, got" in done.stderr
    assert not (tmp_path / "mine.parquet.parts").exists()


def test_what_is_no_address(tmp_path, collected):
    study = tmp_path / "mine.toml"
    study.write_text(SAMPLED)
    done = run("study", study, "--dask", "nonsense", code=2)
    assert "error: --dask nonsense: expected a Dask scheduler that answers, got" in done.stderr
    # and in a process of its own, whose threads may have something to say when it ends
    alone = subprocess.run(command(study, "--dask", "nonsense"), capture_output=True, text=True, check=False)
    assert (alone.returncode, alone.stderr) == (2, done.stderr)


def test_a_dask_cluster_without_workers(tmp_path, collected):
    from distributed import LocalCluster

    study = tmp_path / "mine.toml"
    study.write_text(SAMPLED)
    empty: Any = LocalCluster(n_workers=0, host="127.0.0.1", dashboard_address=":0", silence_logs=50)
    with empty:
        address = empty.scheduler_address
        done = run("study", study, "--dask", address, code=2)
    assert f"error: --dask {address}: expected a cluster with workers, got none" in done.stderr
    assert "Traceback" not in done.stderr
