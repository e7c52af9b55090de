import re

import pytest
import torch

from ablation import memory_table, paper_memory, paper_numbers, recorded_memory
from foundpose.features import PcaProjection
from foundpose.representation import ObjectRepresentation, RepresentationInfo
from tests.experiments.ablation.runs import markdown_rows, sweep_run
from tests.experiments.ablation.test_tables import check_latex, check_markdown

MIB = 2**20


@pytest.mark.parametrize(
    ("templates", "dimensions", "words", "descriptors", "bow"),
    [(800, 256, 2048, 234.4, 6.25), (400, 128, 1024, 58.6, 1.56)],
)
def test_the_papers_representations(
    templates: int, dimensions: int, words: int, descriptors: float, bow: float
) -> None:
    sizes = paper_memory(templates, 300, dimensions, words)
    assert sizes["descriptors"] / MIB == pytest.approx(descriptors, abs=0.05)
    assert sizes["template_bow"] / MIB == pytest.approx(bow, abs=0.005)
    assert sizes["total"] == sizes["descriptors"] + sizes["template_bow"]
    half = paper_memory(templates, 300, dimensions, words, bytes_per_scalar=2)
    assert half["total"] * 2 == sizes["total"]


def test_the_printed_figures_follow_from_the_closed_form() -> None:
    facts = paper_numbers()["memory"]
    for each in facts["representations"]:
        sizes = paper_memory(each["templates"], 300, each["dimensions"], each["words"])
        # 234.4 is printed as 234, 58.6 as 59: the descriptors alone, and not the total of 240.6 or 60.2.
        assert round(sizes["descriptors"] / MIB) == each["printed_mb"]
        assert round(sizes["total"] / MIB) != each["printed_mb"]
    one = paper_memory(1, facts["patches_per_template"], 256, 2048)
    assert one["descriptors"] / 1024 == facts["descriptors_kb_per_template"]
    assert one["template_bow"] / 1024 == facts["bag_of_words_kb_per_template"]
    osop = facts["others"]["OSOP"]
    # Decimal or binary, 16384 × 92232 × 4 bytes are 5.6 to 6.0 GB; against 234 MB that is 25 times as much.
    assert osop["dimensions"] * osop["templates"] * 4 / 2**30 == pytest.approx(
        osop["gb_per_object"], abs=0.05
    )
    assert osop["gb_per_object"] * 1024 / 234 == pytest.approx(osop["times_ours"], abs=1)


def test_sizes_must_be_positive() -> None:
    with pytest.raises(ValueError, match="must be positive"):
        paper_memory(0, 300, 256, 2048)


def test_the_table_has_every_part_and_the_papers_beside_it(oracle_blob: ObjectRepresentation) -> None:
    sizes = oracle_blob.memory_bytes()
    text = memory_table({"blob": oracle_blob, "half": {"descriptors": 100 * MIB, "total": 100 * MIB}})
    check_markdown(text)
    titles, _, *rows = markdown_rows(text)
    shown = {row[0]: dict(zip(titles[1:], row[1:], strict=True)) for row in rows}
    large, small = (
        f"paper: {facts} words" for facts in ("800 templates, 256-d, 2048", "400 templates, 128-d, 1024")
    )
    assert list(shown) == ["blob", "half", large, small]
    assert {name: cell for name, cell in shown[large].items() if cell != "–"} == {
        "descriptors": "234.4",
        "template_bow": "6.25",
        "total": "240.6",
        "printed": "234 MB",
    }
    assert {name: cell for name, cell in shown[small].items() if cell != "–"} == {
        "descriptors": "58.59",
        "template_bow": "1.56",
        "total": "60.16",
        "printed": "59 MB",
    }
    assert {name: cell for name, cell in shown["half"].items() if cell != "–"} == {
        "descriptors": "100.0",
        "total": "100.0",
    }
    match = re.search(r"^Others: (.*)\.$", text, re.MULTILINE)
    assert match is not None
    others = match[1].split(", ")
    assert {*titles[1:], *others} - {"others", "printed"} == set(sizes)
    sizes["others"] = sum(sizes[part] for part in others)
    for part, cell in shown["blob"].items():
        if part != "printed":
            assert float(cell) == pytest.approx(sizes[part] / MIB, abs=0.005)
    check_latex(memory_table({"a_b": oracle_blob}, format="latex"))


def test_runs_of_one_size_share_a_row_named_after_what_makes_the_size() -> None:
    runs = [
        sweep_run(
            {"pca": d, "words": 1024, "seed": seed},
            {"memory.descriptors": d * 0.1 * MIB, "memory.total": d * 0.1 * MIB},
        )
        for d in (128, 256)
        for seed in (0, 1)
    ]
    runs += [sweep_run({"pca": 5}, {"AR": 0.1}), sweep_run({"pca": 6}, {}, status="failed")]
    rows = markdown_rows(memory_table(runs))[2:]
    assert [row[:2] for row in rows[:2]] == [["pca=128", "12.80"], ["pca=256", "25.60"]]
    assert len(rows) == 4
    assert len(markdown_rows(memory_table([]))) == 4


def test_a_total_that_is_not_the_sum_is_refused() -> None:
    with pytest.raises(ValueError, match="'a' take 3 bytes, its total says 4"):
        memory_table({"a": {"descriptors": 1, "words": 2, "total": 4}})


def test_sizes_that_a_run_recorded() -> None:
    run = sweep_run({}, {"AR": 0.1, "memory.words": 2 * MIB, "memory.cls": None, "memory.total": 2 * MIB})
    assert recorded_memory(run) == {"words": 2 * MIB, "total": 2 * MIB}
    row = markdown_rows(memory_table([run]))[2]
    assert row[0] == "size 1"
    assert row.count("2.00") == 2


def test_parts_of_means_need_not_add_up_to_the_last_bit() -> None:
    assert "0.30" in memory_table({"a": {"x": 0.1 * MIB, "y": 0.2 * MIB, "total": 0.3 * MIB}})
    with pytest.raises(ValueError, match="'a' takes no memory"):
        memory_table({"a": {}})


@pytest.mark.parametrize(
    ("templates", "dimensions", "words", "descriptors_mib", "bow_mib"),
    [(800, 256, 2048, 234.375, 6.25), (400, 128, 1024, 58.59375, 1.5625)],
)
def test_a_representation_of_the_papers_size(
    templates: int, dimensions: int, words: int, descriptors_mib: float, bow_mib: float
) -> None:
    """The paper's 234 MB and 59 MB are the patch descriptors of such a representation; the rest comes on top."""
    count = templates * 300

    def empty(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.empty(*shape, dtype=dtype, device="meta")  # sizes without memory

    def representation(storage: torch.dtype) -> ObjectRepresentation:
        return ObjectRepresentation(
            projection=PcaProjection(dimensions),
            words=empty(words, dimensions),
            idf=empty(words),
            template_bow=empty(templates, words),
            descriptors=empty(count, dimensions, dtype=storage),
            points_model=empty(count, 3),
            patch_index=empty(count, dtype=torch.int16),
            template_offsets=torch.arange(templates + 1) * 300,
            T_template_from_model=empty(templates, 4, 4),
            K_template=empty(templates, 3, 3),
            template_cls=None,
            info=RepresentationInfo("x", 1.0, "", {}, 420, 14.0, 6.5, 30),
        )

    sizes = {name: size / 2**20 for name, size in representation(torch.float32).memory_bytes().items()}
    assert sizes["descriptors"] == descriptors_mib
    assert sizes["template_bow"] == bow_mib
    closed_form = paper_memory(templates, 300, dimensions, words)
    assert closed_form["total"] / 2**20 == descriptors_mib + bow_mib
    # Points, patch cells, words and cameras: what the paper leaves out.
    assert 1.0 < sizes["total"] - descriptors_mib - bow_mib < 6.0
    half = representation(torch.float16).memory_bytes()
    assert half["descriptors"] / 2**20 == descriptors_mib / 2
