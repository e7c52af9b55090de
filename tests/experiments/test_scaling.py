"""The app that measures what many objects cost."""

import json
import runpy
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

ROOT = Path(__file__).resolve().parents[2]
SMALL = [
    "sizes.templates=20",
    "sizes.patches=60",
    "sizes.words=64",
    "sizes.components=32",
    "sizes.crop_size=140",
]

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")


@pytest.fixture(scope="module")
def app() -> dict:
    return runpy.run_path(str(ROOT / "experiments" / "scaling.py"))


def config(*overrides: str):
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose("scaling", overrides=[*SMALL, *overrides])


def test_pq_alone_has_the_bytes_of_the_configuration(app, tmp_path) -> None:
    cfg = config("counts=[2]", "storages=[pq,pq8]", "crops=2", "onboarder.pq_subspaces=16")
    before = cfg.copy()
    plain, eight = app["measure"](cfg, tmp_path)
    assert cfg == before
    # 20 templates of at most 60 patches, and 16 in place of 8 bytes for each; the codebooks are as large.
    assert 0.9 < (plain.disk - eight.disk) / (2 * 20 * 60 * 8) <= 1.0
    assert app["parse_storage"]("pq8", 16) == ("pq", 8)


@pytest.mark.slow
def test_rows_are_measured_as_far_as_the_disk_allows(app, tmp_path) -> None:
    cfg = config("counts=[3,2,2000]", "storages=[float32,pq8]", "crops=4", "disk_limit=0.01")
    rows = app["measure"](cfg, tmp_path / "objects")
    assert [(row.storage, row.objects, row.measured) for row in rows] == [
        (storage, objects, objects < 2000) for storage in ("float32", "pq8") for objects in (2, 3, 2000)
    ]
    two, three, many = rows[:3]
    assert two.disk / 2 == three.disk / 3 == many.disk / 2000
    assert many.open_seconds == pytest.approx(three.open_seconds * 2000 / 3)
    assert (many.first, many.again) == (three.first, three.again)
    # Four crops hit nearly four of 2000 objects, and 65/27 of three.
    assert app["expected_distinct"](3, 4) == pytest.approx(65 / 27)
    assert app["expected_distinct"](1, 4) == 1.0
    used = [row.resident_used - row.resident_open for row in (three, many)]
    assert used[1] == pytest.approx(used[0] * app["expected_distinct"](2000, 4) / (65 / 27))
    assert app["expected_distinct"](2000, 4) == pytest.approx(4, abs=0.01)
    assert all(row.first > 0 and row.again > 0 and row.open_seconds > 0 for row in rows)
    # The same object in fewer bytes.
    assert rows[3].disk < 0.6 * two.disk
    # Nothing is left behind.
    assert list((tmp_path / "objects").iterdir()) == []
    text = app["table"](rows)
    assert text.count("≈ 2000") == 2
    assert len(text.splitlines()) == 8
    panels = app["plot"](rows).axes
    assert [len(panel.lines) for panel in panels] == [6, 6, 12]


def test_the_app_writes_its_results(app, tmp_path, monkeypatch, capsys) -> None:
    arguments = [
        "scaling.py",
        f"hydra.run.dir={tmp_path}",
        "counts=[2]",
        "storages=[int8]",
        "crops=2",
        *SMALL,
    ]
    monkeypatch.setattr(sys, "argv", arguments)
    runpy.run_path(str(ROOT / "experiments" / "scaling.py"), run_name="__main__")
    content = json.loads((tmp_path / "scaling.json").read_text())
    assert [(row["storage"], row["objects"]) for row in content["rows"]] == [("int8", 2)]
    assert content["hardware"]
    assert (tmp_path / "scaling.md").read_text() in capsys.readouterr().out
    assert {"scaling.png", "scaling.pdf"} <= {path.name for path in tmp_path.iterdir()}


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("disk_limit=1e-6", "2 objects of .* MiB do not fit in 0.0 GiB"),
        ("counts=[]", "counts and crops must be at least 1"),
        ("crops=0", "counts and crops must be at least 1"),
        ("storages=[int4]", r"storage must be one of .*, got 'int4'"),
        ("storages=[pq7]", "pq_subspaces must divide the descriptors' 32 components, got 7"),
    ],
)
def test_bad_settings(app, tmp_path, override, message) -> None:
    cfg = config("counts=[2]", "crops=2", "storages=[float16]", override)
    with pytest.raises(ValueError, match=message):
        app["measure"](cfg, tmp_path / "objects")
