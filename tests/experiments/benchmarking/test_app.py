import json
import runpy
import sys
import warnings
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]


def run_app(monkeypatch, *overrides):
    """Run the app in this process as the command line would."""
    monkeypatch.setattr(sys, "argv", ["benchmark.py", *overrides])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    runpy.run_path(str(ROOT / "experiments" / "benchmark.py"), run_name="__main__")


@pytest.mark.slow
def test_everything_small(monkeypatch, tmp_path, capsys):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # of settings that do not fit the workload
        warnings.filterwarnings("default", module="hydra")
        run_app(
            monkeypatch,
            *("quick=true", "measure.repeats=2", "measure.warmup=0", "measure.seconds=0.01"),
            *("references.kmeans=true", "references.kmeans_iterations=5", "curve_seconds=0.01"),
            *("curves.batch=[1,2]", "curves.ransac_iterations=[50,100]", "curves.lm_iterations=[5,10]"),
            *(f"curves.{name}=[]" for name in ("templates", "words", "patches", "hypotheses")),
            f"hydra.run.dir={tmp_path}",
        )
    content = json.loads((tmp_path / "benchmark.json").read_text())
    groups = {row["group"] for row in content["rows"]}
    assert groups == {"stages", "pipeline", "backward", "onboarding"}
    for batch_size in (1, 2):
        names = {
            row["name"]
            for row in content["rows"]
            if row["group"] == "stages" and row["batch_size"] == batch_size
        }
        assert {"yardstick: all blocks", "extractor", "crop", "retrieval", "matching"} <= names
        assert {"PnP of 5 hypotheses", "refinement of 1 hypothesis", "refinement of 5 hypotheses"} <= names
    for row in content["rows"]:
        assert 0 < row["lower"] <= row["median"] <= row["upper"]
        assert row["memory_reason"] is not None or row["memory_rise"] >= 0
        assert (row["share_of_yardstick"] is not None) == (row["unit"] == "crop")
    onboarding = {row["name"]: row for row in content["rows"] if row["group"] == "onboarding"}
    assert list(onboarding) == [
        *("template cameras", "rendering", "registration", "extractor", "PCA", "k-means", "bags of words"),
        *("save", "load"),
    ]
    assert onboarding["rendering"]["projected"] == pytest.approx(40 * onboarding["rendering"]["per_unit"])
    assert len(content["references"]) == 3
    assert [curve["name"] for curve in content["curves"]] == ["batch", "ransac_iterations", "lm_iterations"]
    assert content["settings"]["sizes"]["templates"] == 40
    assert content["hardware"]["cpu"]
    assert content["checks"]
    plots = {path.name for path in (tmp_path / "plots").glob("*.png")}
    assert plots == {
        *("batch.png", "ransac_iterations.png", "lm_iterations.png"),
        *("stages-batch1.png", "stages-batch2.png"),
    }
    assert (tmp_path / "benchmark.md").read_text() in capsys.readouterr().out
    # Nothing is left of files that were needed on the way.
    assert {path.name for path in tmp_path.iterdir() if path.is_dir()} <= {"plots", ".hydra"}


@pytest.mark.slow
def test_comparison_with_an_earlier_run(monkeypatch, tmp_path, capsys):
    small = ["quick=true", "groups=[stages]", "batch_sizes=[1]", "measure.repeats=3"]
    run_app(monkeypatch, *small, f"hydra.run.dir={tmp_path / 'before'}")
    path = tmp_path / "before" / "benchmark.json"
    content = json.loads(path.read_text())
    for row in content["rows"]:  # as if matching had taken no time, and all else for ever
        factor = 1e-6 if row["name"] == "matching" else 1e3
        if row["name"] != "yardstick: all blocks":
            row |= {name: factor * row[name] for name in ("lower", "median", "upper")}
    path.write_text(json.dumps(content))
    with pytest.raises(SystemExit) as stopped:
        run_app(monkeypatch, *small, f"compare={path}", f"hydra.run.dir={tmp_path / 'now'}")
    assert stopped.value.code == 1
    found = [line for line in capsys.readouterr().out.splitlines() if "SLOWER" in line]
    assert len(found) == 1
    assert found[0].startswith("SLOWER: stages, matching, batch 1:")


@pytest.mark.slow
def test_other_stages_and_double_precision(monkeypatch, tmp_path):
    run_app(
        monkeypatch,
        *("quick=true", "groups=[stages,pipeline,references]", "batch_sizes=[2]", "dtype=float64"),
        *("extractor=dense_sift", "pnp=epnp_ransac", "~refiner", "matcher=soft", "num_hypotheses=2"),
        *("sizes.templates=30", f"hydra.run.dir={tmp_path}"),
    )
    content = json.loads((tmp_path / "benchmark.json").read_text())
    names = [row["name"] for row in content["rows"]]
    assert "PnP of 2 hypotheses" in names
    assert "pipeline, coarse, with extractor" in names
    assert not any("refine" in name for name in names)
    assert content["settings"]["sizes"]["templates"] == 30
    assert content["curves"] == []


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("quick=maybe", "quick must be true or false"),
        ("groups=[stages,cooking]", "groups must be among"),
        ("batch_sizes=[0]", "batch_sizes must be a list of positive integers, as in [1,16]; got [0]"),
        ("batch_sizes=3", "batch_sizes must be a list of positive integers"),
        ("dtype=float16", "dtype must be one of ['float32', 'float64'], got 'float16'"),
        ("+curves.colour=[1]", "there is no curve 'colour'"),
        ("num_hypotheses=0", "num_hypotheses must be a positive integer, got 0"),
        ("threads=0", "threads must be a positive integer or null, got 0"),
        ("measure.repeats=0", "repeats must be at least 1, got 0"),
        ("sizes.crop_size=425", "crop_size must be a multiple of 14 px"),
        ("sizes.patches=5000", "patches must be at most"),
        ("device=toaster", "device must be cpu, cuda"),
        ("precision=bf15", "precision must be"),
        ("compare=conf/benchmark.yaml", "compare must be the benchmark.json of an earlier run"),
    ],
)
def test_wrong_settings_give_one_line(override, message, monkeypatch, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        run_app(monkeypatch, "quick=true", override, f"hydra.run.dir={tmp_path}")
    assert stopped.value.code == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert len(lines) == 1
    assert message in lines[0]
    assert not (tmp_path / "benchmark.json").exists()
