import dataclasses
import math

import pytest
import torch

from foundpose.bop import (
    BopError,
    PoseResult,
    Target,
    best_of_targets,
    check_times,
    read_results,
    result_file_name,
    write_results,
)
from foundpose.geometry import se3_exp

HEADER = "scene_id,im_id,obj_id,score,R,t,time"
LINE = "1,2,3,0.5,1 0 0 0 1 0 0 0 1,10 20 30,0.1"


def same(a: PoseResult, b: PoseResult) -> bool:
    return torch.equal(a.T_camera_from_model, b.T_camera_from_model) and all(
        getattr(a, field.name) == getattr(b, field.name)
        for field in dataclasses.fields(PoseResult)
        if field.name != "T_camera_from_model"
    )


def random_result(generator, im_id=3, time=0.5, dtype=torch.float64) -> PoseResult:
    T = torch.eye(4, dtype=dtype)
    T[:3, :3] = se3_exp(torch.randn(6, generator=generator, dtype=torch.float64))[:3, :3]
    T[:3, 3] = torch.randn(3, generator=generator, dtype=dtype) * 300
    score = float(torch.rand((), generator=generator, dtype=torch.float64))
    return PoseResult(2, im_id, 5, score, T, time)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_reading_gives_what_was_written(tmp_path, generator, dtype):
    times = torch.rand(20, generator=generator, dtype=torch.float64).tolist()
    results = [random_result(generator, i, time, dtype) for i, time in enumerate(times)]
    path = tmp_path / "deep" / "results.csv"
    write_results(path, results)
    lines = path.read_text().splitlines()
    assert lines[0] == HEADER
    assert all(len(line.split(",")) == 7 for line in lines)
    again = read_results(path)
    assert all(r.T_camera_from_model.dtype == torch.float64 for r in again)
    wanted = [dataclasses.replace(r, T_camera_from_model=r.T_camera_from_model.double()) for r in results]
    assert all(same(a, b) for a, b in zip(wanted, again, strict=True))
    write_results(path, again)
    assert path.read_text().splitlines() == lines
    write_results(path, [])
    assert read_results(path) == []


def test_one_time_per_image(tmp_path, generator):
    results = [random_result(generator, im_id, t) for im_id, t in ((3, 0.5), (3, 0.7), (4, -1.0), (4, -1.0))]
    with pytest.raises(BopError, match=r"image 3 of scene 2 have different times, 0\.5 and 0\.7 s"):
        check_times(results)
    write_results(tmp_path / "r.csv", results)
    again = read_results(tmp_path / "r.csv")
    assert [r.time for r in again] == [0.7, 0.7, -1.0, -1.0]
    check_times(again)
    for difference, fails in ((0.0009, False), (0.0011, True)):
        pair = [dataclasses.replace(results[0], time=t) for t in (10.0, 10.0 + difference)]
        if fails:
            with pytest.raises(BopError, match="different times"):
                check_times(pair)
        else:
            check_times(pair)


@pytest.mark.parametrize("what", ["score", "time", "R", "t"])
def test_nothing_is_written_of_what_is_not_finite(tmp_path, generator, what):
    result = random_result(generator)
    if what in ("score", "time"):
        result = dataclasses.replace(result, **{what: math.inf})
    else:
        result.T_camera_from_model[0, 0 if what == "R" else 3] = math.nan
    with pytest.raises(BopError, match="object 5 in image 3 of scene 2 has numbers that are not finite"):
        write_results(tmp_path / "r.csv", [random_result(generator), result])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "text",
    [
        f"{HEADER}\n{LINE}\n",
        f"{HEADER}\n{LINE}",
        f"{LINE}\n",
        f"{HEADER}\r\n{LINE}\r\n",
        f"\ufeff{HEADER}\n{LINE}\n\n",
        f"{HEADER}\n{LINE.replace(',', ' , ')}\n",
    ],
)
def test_reads_what_others_write(tmp_path, text):
    path = tmp_path / "r.csv"
    path.write_bytes(text.encode())
    (result,) = read_results(path)
    T = torch.eye(4, dtype=torch.float64)
    T[:3, 3] = torch.tensor([10.0, 20.0, 30.0])
    assert same(result, PoseResult(1, 2, 3, 0.5, T, 0.1))
    path.write_bytes(text.replace("0.1", "-1").encode())
    assert read_results(path)[0].time == -1


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (HEADER, "a second header"),
        ("1,2,3,0.5,1 2 3,0 0 0,0.1", "R must be 9 and t 3 numbers, got 3 and 3"),
        ("1,2,3,0.5,1 0 0 0 1 0 0 0 1,0 0,0.1", "got 9 and 2"),
        ("1,2,3,0.5,1 0 0 0 1 0 0 0 1,0 0 0", "expected 7 fields .*, got 6"),
        (LINE + ",", "expected 7 fields .*, got 8"),
        (LINE.replace("0.5", "nan"), "score must be finite"),
        (LINE.replace("0.5", "high"), "could not convert"),
        (LINE.replace("20", "inf"), "t must be finite"),
        (LINE.replace("1 0 0 0", "1 0 nan 0"), "R must be finite"),
        (LINE.replace("0.1", "-inf"), "time must be finite"),
        (LINE.replace("0.1", "-0.5"), "time must be at least 0, or -1"),
        (LINE.replace("1 0 0 0 1 0 0 0 1", "-1 0 0 0 1 0 0 0 1"), "a reflection scaled by 1"),
        (LINE.replace("1 0 0 0 1 0 0 0 1", "1e3 0 0 0 1e3 0 0 0 1e3"), "a rotation scaled by 1000"),
        (LINE.replace("1 0 0 0 1 0 0 0 1", "1 0 0 0 1 0 0 0.5 1"), "axes are not orthogonal"),
        (LINE.replace("1 0 0 0 1 0 0 0 1", "0 0 0 0 0 0 0 0 0"), "a rotation scaled by 0"),
        (LINE.replace("1,2", "1,2.5", 1), "invalid literal for int"),
    ],
)
def test_bad_lines_are_named(tmp_path, line, message):
    path = tmp_path / "r.csv"
    path.write_text(f"{HEADER}\n{LINE}\n\n{line}\n")
    with pytest.raises(BopError, match=rf"r\.csv, line 4: not a BOP result \(.*{message}"):
        read_results(path)


def test_missing_and_empty_files(tmp_path):
    (tmp_path / "other.csv").write_text("")
    with pytest.raises(FileNotFoundError, match=r"no results file at .*; .* holds other\.csv"):
        read_results(tmp_path / "none.csv")
    with pytest.raises(BopError, match=r"other\.csv is empty"):
        read_results(tmp_path / "other.csv")


def test_a_published_submission(lmo_root, tmp_path):
    path = lmo_root.parent / "bop_reference" / "megapose_lmo50.csv"
    if not path.is_file():
        pytest.skip(f"no {path}")
    results = read_results(path)
    assert len(results) == 415
    check_times(results)
    write_results(tmp_path / "again.csv", results)
    again = read_results(tmp_path / "again.csv")
    assert all(same(a, b) for a, b in zip(results, again, strict=True))
    assert [line.split(",")[:6] for line in (tmp_path / "again.csv").read_text().splitlines()] == [
        line.split(",")[:6] for line in path.read_text().splitlines()
    ]


def test_best_of_targets():
    keys = [(1, 0, 5), (1, 0, 5), (1, 0, 6), (1, 0, 5), (1, 1, 5), (2, 0, 5), (1, 0, 5)]
    scores = [0.3, 0.5, 0.1, 0.5, 0.9, 0.9, 0.2]
    T = torch.eye(4, dtype=torch.float64)
    results = [PoseResult(*key, score, T, 0.1) for key, score in zip(keys, scores, strict=True)]
    target = Target(1, 0, 5, 1)

    def kept(*targets):
        return [next(i for i in range(7) if results[i] is r) for r in best_of_targets(results, targets)]

    assert kept(target) == [1]
    assert kept(target._replace(inst_count=2)) == [1, 3]
    assert kept(target._replace(inst_count=3)) == [0, 1, 3]
    assert kept(target._replace(inst_count=9)) == [0, 1, 3, 6]
    assert kept(Target(2, 0, 5, 1), target, Target(3, 0, 5, 1)) == [1, 5]
    assert kept(Target(1, 0, None, None)) == [0, 1, 2, 3, 6]
    assert best_of_targets([], [target]) == []
    with pytest.raises(ValueError, match="score 1 is NaN"):
        best_of_targets([results[0], dataclasses.replace(results[1], score=math.nan)], [target])


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (("foundpose", "lmo", "test"), "foundpose_lmo-test.csv"),
        (("found_pose_5n", "tless", "test_primesense"), "found-pose-5n_tless-test.csv"),
        (("a-b", "hb", "test/test_primesense/"), "a-b_hb-test.csv"),
        (("m", "my_parts", "val"), "m_my-parts-val.csv"),
    ],
)
def test_result_file_name(arguments, name):
    assert result_file_name(*arguments) == name


@pytest.mark.parametrize(
    "arguments", [("", "lmo", "test"), ("a/b", "lmo", "test"), ("m", "", "test"), ("m", "d", "")]
)
def test_bad_result_file_names(arguments):
    with pytest.raises(ValueError, match="must be a name without slashes, got method"):
        result_file_name(*arguments)
