import json
import re
from dataclasses import replace
from pathlib import Path

from ablation.page import write_runs_page
from tests.experiments.ablation.runs import sweep_run


def scores(share: float) -> dict:
    curve = {"thresholds": [0.1, 0.2], "thresholds_are": "diameters", "recalls": [share, share]}
    return {"mssd": curve, "vsd": curve | {"recalls": [[share, share], [0.0, 0.0]]}} | {
        "objects": {"5": {"AR": None, "AR_MSSD": share, "AR_VSD": share / 2}}
    }


def test_the_page_has_all_runs_and_what_they_found(tmp_path: Path) -> None:
    runs = []
    for words, share in ((512, 0.25), (1024, 0.5)):
        run = sweep_run({"words": words, "layer": 9}, {"AR": None, "AR_MSPD": share, "memory.total": 2**20})
        runs.append(replace(run, folder=tmp_path / str(words)))
        (tmp_path / str(words)).mkdir()
        (tmp_path / str(words) / "scores.json").write_text(json.dumps(scores(share)))
    runs.append(sweep_run({"words": 2048, "layer": 9}, {}, status="failed", error="too many words"))
    write_runs_page(runs, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    cases = json.loads(found[1])["rows"]
    assert [case["words"] for case in cases] == [2048, 512, 1024]  # worst first
    assert all("layer" not in case for case in cases)
    assert cases[0]["note"] == "too many words"
    assert cases[2]["AR_MSPD"] == 50.0
    assert cases[2]["memory.total"] == 1.0
    assert "<th>object 5</th>" in page
    assert "AR_MSSD by object" in page
    assert "AR by object" not in page
    assert "Recall under VSD (the 2 best runs)" in page
    assert '"lmo sweep words=1024"' in page
