import json

import pytest

from benchmarking.checks import make_checks
from benchmarking.comparison import compare, describe, read_benchmark
from benchmarking.curves import Curve, Point
from benchmarking.inference import CANDIDATES, COARSE, HOOKED, REFINE_ONE, RETRIEVAL, YARDSTICK
from benchmarking.onboarding import BAGS, KMEANS, PCA, RENDERING, WHOLE
from benchmarking.references import Comparison
from benchmarking.report import BenchmarkResult, duration, render, write_report
from benchmarking.tasks import Row

MIB = 2**20


def row(name, seconds, batch_size=1, group="stages", unit="crop", **changes):
    units = changes.pop("units", batch_size or 1)
    values = {
        "lower": 0.9 * seconds,
        "upper": 1.1 * seconds,
        "calls": 7,
        "per_unit": seconds / units,
        "memory_rise": 3 * MIB,
        "memory_peak": 500 * MIB,
        "memory_reason": None,
        "host_syncs": None,
        "projected": None,
        "note": "",
        "facts": {},
    }
    return Row(group, name, batch_size, units, unit, seconds, **(values | changes))


ROWS = [
    row(YARDSTICK, 0.5),
    row(HOOKED, 0.4),
    row(REFINE_ONE, 0.06),
    row(COARSE, 0.04, group="pipeline"),
    row(YARDSTICK, 8.0, 16),
    row(REFINE_ONE, 0.32, 16),
    row(COARSE, 0.8, 16, group="pipeline", facts={"poses_found": 1.0}),
    row(CANDIDATES, 0.064, 16),
    row(RETRIEVAL, 0.16, 16),
    row(RENDERING, 3.2, 16, group="onboarding", unit="template", units=64, projected=40.0),
    row(PCA, 2.0, None, group="onboarding", unit="object"),
    row(BAGS, 3.5, None, group="onboarding", unit="object"),
    row(WHOLE, 90.0, None, group="onboarding", unit="object", memory_rise=1024 * MIB),
]
COMPARISONS = [
    Comparison(f"{KMEANS}, 9 words: faiss", 20.0, 98.0, 4.9, {"inertia_ratio": 1.004}),
    Comparison("polish", None, None, None, {}, "OpenCV is not installed"),
]


def checks_by_name(*arguments):
    return {check.name: check for check in make_checks(*arguments)}


def test_checks_on_a_cpu():
    checks = checks_by_name(ROWS, COMPARISONS, 5, "cpu")
    figures = {name: (round(check.value, 6), check.passed) for name, check in checks.items()}
    assert figures == {
        "all coarse stages but the extractor, batch 1, share of the yardstick": (8.0, True),
        "the same in time; a quarter of the released code's on a machine with two cores": (40.0, False),
        "refinement of 1 hypothesis, batch 1, share of the yardstick": (12.0, False),
        "all coarse stages but the extractor, batch 16, share of the yardstick": (10.0, True),
        "re-ranking, batch 16, per crop": (6.0, False),
        "coarse stages, per crop at batch 16 beside batch 1": (125.0, False),
        "refinement of 1 hypothesis, per crop at batch 16 beside batch 1": (pytest.approx(33.333333), True),
        "rendering of all templates": (40.0, True),
        "PCA and bags of words": (5.5, False),
        "peak memory of onboarding over the model's": (1.0, True),
        "k-means, 9 words: faiss, times faster": (4.9, True),
        "k-means, 9 words: faiss, ratio of inertias": (1.004, False),
    }


def test_checks_on_a_gpu():
    rows = [
        row(HOOKED, 0.1, 32),
        row(COARSE, 0.02, 32, group="pipeline"),
        row("refinement of 5 hypotheses", 0.06, 32),
        row(YARDSTICK, 0.2, 32),
    ]
    figures = {
        name: (check.value, check.passed) for name, check in checks_by_name(rows, [], 5, "cuda").items()
    }
    assert figures == {
        "all coarse stages but the extractor, batch 32, share of the extractor": (pytest.approx(20.0), True),
        "refinement of 5 hypotheses, batch 32, share of the extractor": (pytest.approx(60.0), False),
    }
    assert checks_by_name(rows[1:], [], 5, "cuda") == {}
    assert checks_by_name([], [], 5, "cpu") == {}


@pytest.fixture
def result():
    hardware = {
        "cpu": "A fine CPU",
        "cores_available": 2,
        "threads": 2,
        "gpu": None,
        "load_average": 0.3,
    }
    versions = {"torch": "2.6", "foundpose": "0.1.0", "commit": "0123456789abcdef"}
    curve = Curve("batch", {"crop": [Point(1, 0.02, 0.01, 0.03, 5), Point(2, 0.01, 0.01, 0.01, 5)]}, None)
    checks = make_checks(ROWS, COMPARISONS, 5, "cpu")
    return BenchmarkResult(
        {"device": "cpu"}, hardware, versions, list(ROWS), [curve], list(COMPARISONS), checks, 12.3
    )


def test_shares(result):
    refine, coarse, rendering = ROWS[2], ROWS[6], ROWS[9]
    assert result.share(refine, YARDSTICK) == pytest.approx(0.12)
    assert result.share(refine, HOOKED) == pytest.approx(0.15)
    assert result.share(coarse, YARDSTICK) == pytest.approx(0.1)
    assert result.share(coarse, HOOKED) is None  # not measured at batch 16
    assert result.share(rendering, YARDSTICK) is None


def test_files(result, tmp_path):
    text = write_report(result, tmp_path)
    assert (tmp_path / "benchmark.md").read_text() == text
    content = json.loads((tmp_path / "benchmark.json").read_text())
    assert content["rows"][2] == {
        "group": "stages",
        "name": REFINE_ONE,
        "batch_size": 1,
        "units": 1,
        "unit": "crop",
        "median": 0.06,
        "lower": pytest.approx(0.054),
        "upper": pytest.approx(0.066),
        "calls": 7,
        "per_unit": 0.06,
        "memory_rise": 3 * MIB,
        "memory_peak": 500 * MIB,
        "memory_reason": None,
        "host_syncs": None,
        "projected": None,
        "note": "",
        "facts": {},
        "share_of_yardstick": pytest.approx(0.12),
        "share_of_extractor": pytest.approx(0.15),
    }
    assert content["curves"][0]["series"]["crop"][1] == {
        "x": 2,
        "median": 0.01,
        "lower": 0.01,
        "upper": 0.01,
        "calls": 5,
    }
    assert content["checks"][0]["passed"] is True
    assert content["versions"]["commit"] == "0123456789abcdef"
    names = {path.name for path in (tmp_path / "plots").iterdir()}
    assert names == {
        f"{stem}{suffix}"
        for stem in ("batch", "stages-batch1", "stages-batch16")
        for suffix in (".png", ".pdf")
    }
    before = {path.name: path.read_bytes() for path in (tmp_path / "plots").iterdir()}
    write_report(result, tmp_path)
    assert before == {path.name: path.read_bytes() for path in (tmp_path / "plots").iterdir()}


def test_tables(result):
    lines = [" ".join(line.split()) for line in render(result).splitlines()]
    assert "A fine CPU, 2 cores, 2 threads; torch 2.6, foundpose 0.1.0 (0123456789ab); 12 s." in lines
    refine = "| refinement of 1 hypothesis | 1 | 60 ms | 54 ms to 66 ms | 7 | 60 ms | 12 % | 15 % | 3 MiB | |"
    assert refine in lines
    rendering = (
        "| rendering | 16 | 3.2 s | 2.88 s to 3.52 s | 7 | 50 ms/template | 40 s (projected) | 3 MiB | |"
    )
    assert rendering in lines
    assert "| polish | – | – | – | OpenCV is not installed |" in lines
    assert "| rendering of all templates | 40 s | ≤ 60 s | yes |" in lines
    assert not any("busy" in line for line in lines)

    result.hardware["load_average"] = 1.7
    result.rows.append(
        row("odd", 1.0, memory_rise=None, memory_reason="there is no /proc here", host_syncs=2)
    )
    text = render(result)
    assert "The machine was busy when this began (load average 1.7 on 2 cores)" in text
    assert "memory: there is no /proc here" in text
    assert "2 host syncs" in text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (123.4, "123 s"),
        (1.0, "1 s"),
        (0.0123, "12.3 ms"),
        (4.5e-6, "4.5 µs"),
        (float("nan"), "–"),
        (0.0, "0 µs"),
    ],
)
def test_duration(seconds, text):
    assert duration(seconds) == text


def test_slower_stages(result):
    before = result.as_json()
    assert not any(change.slower for change in compare(before, before))
    result.rows[0] = row(YARDSTICK, 1.0)  # a machine half as fast
    result.rows[2] = row(REFINE_ONE, 0.16)  # a third slower than that
    result.rows[3] = row(COARSE, 0.14, group="pipeline", lower=0.08)  # perhaps
    now = result.as_json()
    changes = {(change.name, change.batch_size): change for change in compare(before, now)}
    assert (changes[REFINE_ONE, 1].before, changes[REFINE_ONE, 1].now) == pytest.approx((0.12, 0.16))
    assert [change.name for change in changes.values() if change.slower] == [REFINE_ONE]
    assert changes[HOOKED, 1].now == pytest.approx(0.4)
    # By template or object, in passes of one crop.
    assert changes[RENDERING, 16].before == pytest.approx(0.1)
    lines = describe(list(changes.values()), before, now).splitlines()
    assert lines[0].startswith(
        f"SLOWER: stages, {REFINE_ONE}, batch 1: 12.00% → 16.00% of a forward pass (× 1.33)"
    )
    assert lines[1].startswith("1 of 11 stages are more than 25% slower than in 0123456789ab")


def test_what_cannot_be_compared(result, tmp_path):
    path = tmp_path / "benchmark.json"
    settings = dict.fromkeys(("sizes", "num_hypotheses", "ransac_iterations", "lm_iterations"), 1)
    settings |= {"dtype": "float32", "precision": None}
    result.settings = settings
    path.write_text(json.dumps(result.as_json()))
    assert read_benchmark(path, settings)["rows"]
    with pytest.raises(ValueError, match="its sizes is 1, and 2 here"):
        read_benchmark(path, settings | {"sizes": 2})
    with pytest.raises(ValueError, match="of an earlier run"):
        read_benchmark(tmp_path / "none.json", settings)
