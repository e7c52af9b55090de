import os
import signal
import time

import pytest
import torch
from filelock import FileLock

from foundpose.onboarding import ArtefactStore
from tests.processes import CONTEXT

FACTS = {"mesh": "abc", "size": 420, "nested": {"sigma": 0.5, "name": None}}


def content(value=1.0):
    return {"a": torch.full((300, 7), value), "b": torch.arange(5), "empty": torch.zeros(4, 0)}


class Maker:
    """Counts how often it is asked."""

    def __init__(self, value=1.0):
        self.value, self.calls = value, 0

    def __call__(self):
        self.calls += 1
        return content(self.value)


def same(tensors, others):
    return tensors.keys() == others.keys() and all(
        torch.equal(t, others[name]) and t.dtype == others[name].dtype for name, t in tensors.items()
    )


def test_made_once_and_told_apart_by_facts(tmp_path):
    store, make = ArtefactStore(tmp_path / "new" / "folder"), Maker()
    assert same(store.get("words", FACTS, make), content())
    assert same(ArtefactStore(store.folder).get("words", dict(reversed(FACTS.items())), make), content())
    assert make.calls == 1
    for kind, facts in (
        ("patches", FACTS),
        ("words", FACTS | {"size": 421}),
        ("words", FACTS | {"size": "420"}),
        ("words", FACTS | {"nested": {"sigma": 0.5000001, "name": None}}),
        ("words", FACTS | {"more": None}),
    ):
        other = Maker(2.0)
        assert same(store.get(kind, facts, other), content(2.0))
        assert other.calls == 1
    assert same(store.get("words", FACTS, make), content())
    assert make.calls == 1


@pytest.mark.parametrize(
    "damage", ["truncated", "header only", "empty", "flipped bit", "text", "other tensors"]
)
def test_a_broken_file_is_made_again(tmp_path, damage):
    store, make = ArtefactStore(tmp_path), Maker()
    store.get("words", FACTS, make)
    path = store.path("words", FACTS)
    data = bytearray(path.read_bytes())
    if damage == "truncated":
        data = data[:-1]
    elif damage == "header only":
        data = data[:-8000]
    elif damage == "empty":
        data = b""
    elif damage == "flipped bit":
        data[-1234] ^= 1
    elif damage == "text":
        data = b"not a safetensors file at all"
    else:
        torch.save(content(), path)
        data = path.read_bytes()
    path.write_bytes(data)
    assert same(store.get("words", FACTS, make), content())
    assert make.calls == 2
    assert same(store.get("words", FACTS, make), content())
    assert make.calls == 2


def test_nothing_is_left_of_a_failure(tmp_path):
    def fail():
        raise RuntimeError("no words today")

    store, make = ArtefactStore(tmp_path), Maker()
    with pytest.raises(RuntimeError, match="no words today"):
        store.get("words", FACTS, fail)
    assert store.entries() == []
    assert same(store.get("words", FACTS, make), content())
    assert not list(tmp_path.glob("words/.*-*"))


def test_size_and_clear(tmp_path):
    store, make = ArtefactStore(tmp_path), Maker()
    assert store.size() == {"total": 0}
    for kind in ("renderings", "words"):
        for size in (1, 2):
            store.get(kind, {"size": size}, make)
    entries = store.entries()
    assert [entry.kind for entry in entries] == ["renderings"] * 2 + ["words"] * 2
    assert {entry.key for entry in entries[:2]} == {store.key("renderings", {"size": s}) for s in (1, 2)}
    size = store.size()
    assert size["total"] == size["renderings"] + size["words"] == sum(e.path.stat().st_size for e in entries)
    assert size["words"] > 2 * 300 * 7 * 4
    # One job reads and another clears: the reader keeps what it has.
    held = store.get("words", {"size": 1}, make)
    leftover = entries[3].path.with_name(f".{entries[3].key}-abc.safetensors")
    busy = entries[2].path.with_name(f".{entries[2].key}-abc.safetensors")
    leftover.touch()
    busy.touch()
    with FileLock(busy.with_name(f".{entries[2].key}.lock")):
        assert store.clear(["words"]) == size["words"]
    assert not leftover.exists()
    assert busy.exists()  # somebody is writing it
    assert same(held, content())
    assert list(store.size()) == ["renderings", "total"]
    make.calls = 0
    store.get("renderings", {"size": 1}, make)
    assert make.calls == 0
    store.get("words", {"size": 1}, make)
    assert make.calls == 1
    store.clear()
    assert store.size() == {"total": 0}
    with pytest.raises(ValueError, match=r"kinds must be a list, as in clear\(\['words'\]\)"):
        store.clear("words")


def _get_slowly(folder, barrier, queue):
    """Ask for one artefact at the same time as others do."""
    make = Maker()

    def slow():
        time.sleep(0.3)
        return make()

    barrier.wait()
    found = ArtefactStore(folder).get("words", FACTS, slow)
    queue.put((same(found, content()), make.calls))


def test_jobs_that_ask_at_once_make_it_once(tmp_path):
    barrier, queue = CONTEXT.Barrier(3), CONTEXT.Queue()
    jobs = [CONTEXT.Process(target=_get_slowly, args=(tmp_path, barrier, queue)) for _ in range(3)]
    for job in jobs:
        job.start()
    results = [queue.get(timeout=600) for _ in jobs]
    for job in jobs:
        job.join()
    assert all(whole for whole, _ in results)
    assert sorted(calls for _, calls in results) == [0, 0, 1]


def _die(folder, moment):
    """Be killed while an artefact is computed, or when half of its file is written."""
    import foundpose.onboarding.artefacts as module

    def die(*arguments, **options):
        if moment == "writing":
            save(*arguments, **options)
            os.truncate(arguments[1], os.path.getsize(arguments[1]) // 2)
        os.kill(os.getpid(), signal.SIGKILL)

    save = module.save_file
    if moment == "writing":
        module.save_file = die
    ArtefactStore(folder).get("words", FACTS, die if moment == "computing" else Maker())


@pytest.mark.parametrize("moment", ["computing", "writing"])
def test_a_killed_writer_leaves_neither_a_broken_file_nor_a_lock(tmp_path, moment):
    job = CONTEXT.Process(target=_die, args=(tmp_path, moment))
    job.start()
    job.join(timeout=600)
    assert job.exitcode == -signal.SIGKILL
    store, make = ArtefactStore(tmp_path), Maker()
    assert store.entries() == []
    assert len(list(tmp_path.glob("words/.*-*.safetensors"))) == (1 if moment == "writing" else 0)
    start = time.monotonic()
    assert same(store.get("words", FACTS, make), content())
    assert time.monotonic() - start < 60  # a lock would be waited for without end
    assert make.calls == 1
    # What the dead one left is gone, too.
    assert not list(tmp_path.glob("words/.*-*.safetensors"))
