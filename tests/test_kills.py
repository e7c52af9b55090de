"""Jobs that are killed at random moments and started again.

Each is killed at two moments, and with ``FOUNDPOSE_ALL_KILLS=1`` in the environment at twenty.
"""

import json
import os
import random
import shutil
import signal
import time

import pytest
from safetensors import safe_open

from tests.bop_dataset import make_bop_dataset
from tests.kill_jobs import JOBS, outcome, run_job
from tests.processes import CONTEXT, finish

pytestmark = pytest.mark.slow
NUM_KILLS = 20 if os.environ.get("FOUNDPOSE_ALL_KILLS") else 2


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return make_bop_dataset(tmp_path_factory.mktemp("kills") / "tiny", images=3)


def start(name, folder, root):
    """Start a job and wait until it is at work."""
    folder.mkdir(exist_ok=True)
    ready = CONTEXT.Event()
    job = CONTEXT.Process(target=run_job, args=(name, folder, root, ready))
    job.start()
    assert ready.wait(120)
    return job


def kill(name, folder, root, moment):
    """Start a job and kill it after so many seconds; its exit code is 0 if it had ended before."""
    job = start(name, folder, root)
    job.join(moment)
    job.kill()
    job.join()
    return job


@pytest.fixture(scope="module", params=JOBS)
def undisturbed(request, root, tmp_path_factory):
    """A job's name, what it leaves when nobody kills it, and the seconds that it takes."""
    folder = tmp_path_factory.mktemp(request.param) / "job"
    job = start(request.param, folder, root)
    begin = time.monotonic()
    finish(job, folder.parent / "job.log")
    left = outcome(folder)
    assert any(left)
    return request.param, left, time.monotonic() - begin


def finished_files(folder):
    """Stored tensors by path, each with what tells it from one that was written later; all of them are whole."""
    found = {}
    for path in folder.rglob("[!.]*.safetensors"):
        with safe_open(path, framework="pt") as file:
            for name in file.keys():  # noqa: SIM118 - not a mapping
                file.get_tensor(name)
        found[path] = path.stat().st_ino
    for path in folder.rglob("[!.]*.json"):
        json.loads(path.read_text())
    return found


@pytest.mark.parametrize("seed", range(NUM_KILLS))
def test_a_killed_job_loses_nothing_that_was_done(undisturbed, root, tmp_path, seed):
    name, expected, seconds = undisturbed
    folder, moment = tmp_path / "job", random.Random(f"{name} {seed}").uniform(0.0, seconds)
    job = kill(name, folder, root, moment)
    while job.exitcode == 0:  # it was faster than when nobody disturbed it
        shutil.rmtree(folder)
        moment /= 2
        job = kill(name, folder, root, moment)
    assert job.exitcode == -signal.SIGKILL
    done = finished_files(folder)
    print(f"{name}, seed {seed}: killed after {moment:.2f} of {seconds:.2f} s, {len(done)} files were there")
    finish(start(name, folder, root), tmp_path / "job.log")
    assert outcome(folder) == expected
    again = finished_files(folder)
    assert {path: again[path] for path in done} == done  # nothing was made twice
    assert not list(folder.rglob(".*-*.safetensors"))  # nor is half a file left
