"""The next templates are rendered while the last ones are described, and nothing else changes."""

import threading
import time

import pytest
import torch

import foundpose.onboarding.onboarder as onboarder_module
from foundpose.onboarding import ArtefactStore, CachedOnboarding
from foundpose.onboarding.prefetch import prefetch
from tests.onboarding.jobs import small_onboarder


def threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name.startswith("prefetch")}


def test_order_and_bound():
    made = []

    def make(item):
        made.append(item)
        return item * 10

    taken = []
    with prefetch(make, range(6)) as results:
        for result in results:
            time.sleep(0.01)
            # The one being worked on, and one ahead.
            assert len(made) <= len(taken) + 2
            taken.append(result)
    assert taken == [0, 10, 20, 30, 40, 50]
    assert made == list(range(6))
    with prefetch(make, []) as results:
        assert list(results) == []
    assert not threads()


def test_the_next_is_made_while_the_last_is_worked_on():
    started = [threading.Event() for _ in range(3)]

    def make(item):
        started[item].set()
        return item

    with prefetch(make, range(3)) as results:
        for item in results:
            assert item == 2 or started[item + 1].wait(10)


def test_without_a_thread_everything_happens_when_asked_for():
    made = []
    with prefetch(lambda item: made.append((item, threading.current_thread())), range(3), False) as results:
        for number, _ in enumerate(results):
            assert len(made) == number + 1
    assert {thread for _, thread in made} == {threading.current_thread()}


def test_an_exception_comes_where_its_result_would():
    def make(item):
        if item == 2:
            raise ValueError("broken")
        return item

    with prefetch(make, range(5)) as results:
        assert [next(results), next(results)] == [0, 1]
        with pytest.raises(ValueError, match="broken"):
            next(results)
    assert not threads()


@pytest.mark.parametrize("kind", [KeyboardInterrupt, RuntimeError])
def test_an_interrupted_block_leaves_no_thread(kind):
    made = []

    def make(item):
        time.sleep(0.02)
        made.append(item)

    def work():
        with prefetch(make, range(100)) as results:
            for _ in results:
                raise kind

    with pytest.raises(kind):
        work()
    assert not threads()
    assert len(made) <= 3
    count = len(made)
    time.sleep(0.05)
    assert len(made) == count


@pytest.fixture
def ahead(monkeypatch):
    """Prefetch on the CPU, too; returns the names of the threads that rendered."""
    names = []

    def always(make, items, ahead):
        def named(item):
            names.append(threading.current_thread().name)
            return make(item)

        return prefetch(named, items, True)

    monkeypatch.setattr(onboarder_module, "prefetch", always)
    return names


def assert_equal(a, b):
    assert a.state_dict().keys() == b.state_dict().keys()
    for name, tensor in a.state_dict().items():
        assert torch.equal(tensor, b.state_dict()[name]), name


def test_onboarding_is_the_same_bit_for_bit(blob, ahead, monkeypatch, tmp_path):
    calls, expected_calls = [], []
    found = small_onboarder()(blob, "blob", lambda *call: calls.append(call))
    cached = CachedOnboarding(small_onboarder(), ArtefactStore(tmp_path / "a"))(blob, "blob")
    assert len(ahead) == 4 * 3
    assert all(name.startswith("prefetch") for name in ahead)
    monkeypatch.undo()
    expected = small_onboarder()(blob, "blob", lambda *call: expected_calls.append(call))
    assert_equal(found, expected)
    assert_equal(cached, expected)
    assert calls == expected_calls
    assert not threads()


def test_nothing_is_recorded_for_gradients(blob, ahead):
    """The mode of autograd belongs to a thread, so the thread must be told."""
    onboarder = small_onboarder()
    modes = []
    onboarder.renderer.register_forward_hook(lambda *_: modes.append(torch.is_grad_enabled()))
    with torch.enable_grad():
        onboarder(blob, "blob")
    assert modes
    assert not any(modes)


@pytest.mark.parametrize("part", ["renderer", "extractor"])
def test_a_failure_in_onboarding_leaves_no_thread(blob, ahead, part):
    onboarder = small_onboarder()
    calls = []

    def fail(*_):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt

    getattr(onboarder, part).register_forward_pre_hook(fail)
    reports = []
    with pytest.raises(KeyboardInterrupt):
        onboarder(blob, "blob", lambda *call: reports.append(call))
    assert not threads()
    assert reports[0] == ("templates", 0, 10)
    assert ("templates", 10, 10) not in reports


@pytest.mark.gpu
def test_cuda_prefetches_without_waiting_and_equals_the_cpu(blob):
    expected = small_onboarder()(blob, "blob")
    onboarder = small_onboarder().cuda()
    names = []
    onboarder.renderer.register_forward_pre_hook(lambda *_: names.append(threading.current_thread().name))
    describe = onboarder.describe

    def strict(*arguments):
        torch.cuda.set_sync_debug_mode("error")
        try:
            return describe(*arguments)
        finally:
            torch.cuda.set_sync_debug_mode("default")

    onboarder.describe = strict
    found = onboarder(blob, "blob")
    assert all(name.startswith("prefetch") for name in names)
    assert found.descriptors.device.type == "cuda"
    for name in ("points_model", "patch_index", "template_offsets", "T_template_from_model", "K_template"):
        # Made on the CPU either way.
        assert torch.equal(found.state_dict()[name].cpu(), expected.state_dict()[name]), name
    # Components may point the other way; distances between descriptors may not change.
    a, b = (r.descriptors[::20].cpu() for r in (found, expected))
    torch.testing.assert_close(torch.cdist(a, a), torch.cdist(b, b), atol=0.05, rtol=1e-3)
