"""Processes of tests: forks of one that has imported everything once, so that each starts in no time."""

import multiprocessing
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["tests.kill_jobs"])


def start_app(name: str, arguments: list[str], log: Path) -> BaseProcess:
    """Start an app on one thread; what it prints goes to ``log``."""
    from tests.kill_jobs import run_app

    job = CONTEXT.Process(target=run_app, args=(name, arguments, log))
    job.start()
    return job


def finish(job: BaseProcess, log: Path) -> str:
    """What a job has printed when it has ended well."""
    job.join(600)
    assert job.exitcode == 0, log.read_text()[-3000:]
    return log.read_text()


def kill_when(job: BaseProcess, reached: Callable[[], bool]) -> None:
    """Kill a job as soon as it has got so far."""
    deadline = time.monotonic() + 600  # on a busy machine
    while not reached():
        assert job.is_alive(), "the run ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.002)
    job.kill()
    job.join()
