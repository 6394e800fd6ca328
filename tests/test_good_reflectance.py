"""Reflectance and rings of files with named columns: the column that tells, and a word on those that are left out."""

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.data.formats import read_scan
from street_corner import corner, pcd_bytes, rows_of, xyz_of

TABLE = corner()
BASE = {axis: TABLE[axis] for axis in "xyz"}
INTENSITY = TABLE["intensity"].astype(np.float32)
RIGHT = torch.from_numpy(INTENSITY / np.float32(255))
ZEROS = np.zeros(len(INTENSITY), np.uint16)


def written(folder, suffix, columns):
    path = folder / f"scan{suffix}"
    table = rows_of({**BASE, **columns})
    if suffix == ".pcd":
        path.write_bytes(pcd_bytes(table))
    elif suffix == ".csv":
        np.savetxt(path, np.array(table.tolist()), "%.9g", ",", header=",".join(table.dtype.names), comments="")
    elif suffix == ".npz":
        np.savez(path, points=xyz_of(TABLE).numpy(), **columns)
    else:
        kinds = {"f": "float", "u": "ushort"}
        lines = [f"property {kinds[table.dtype[name].kind]} {name}" for name in table.dtype.names]
        head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}", *lines, "end_header", ""]
        path.write_bytes("\n".join(head).encode() + table.tobytes())
    return path


@pytest.mark.parametrize("suffix", [".pcd", ".csv", ".npz", ".ply"])
@pytest.mark.parametrize(
    "columns",
    [
        {"reflectivity": ZEROS, "intensity": INTENSITY},
        {"reflectivity": ZEROS + np.uint16(7), "intensity": INTENSITY},
        {"reflectance": -90 + INTENSITY / 5, "intensity": INTENSITY},
        {"reflectance": INTENSITY * 1000, "intensity": INTENSITY},
        {"intensities": INTENSITY},
    ],
    ids=["zeros beside", "one value beside", "decibels beside", "counts beside", "of Open3D"],
)
def test_the_column_that_tells_is_reflectance(tmp_path, suffix, columns):
    scan = read_scan(written(tmp_path, suffix, columns))
    assert scan.reflectance is not None
    assert torch.equal(scan.reflectance, RIGHT)
    assert scan.full_scale == 255
    assert not scan.notes or "intens" not in scan.notes[0].partition("left")[0]


def test_a_column_of_zeros_alone_is_reflectance_of_zero(tmp_path):
    scan = read_scan(written(tmp_path, ".pcd", {"intensity": ZEROS}))
    assert scan.reflectance is not None
    assert not scan.reflectance.any()


@pytest.mark.parametrize("suffix", [".pcd", ".csv", ".npz", ".ply"])
@pytest.mark.parametrize(
    ("values", "why"),
    [(np.round(-90 + INTENSITY / 5, 2), "decibels, are no reflectance"), (INTENSITY * 1000, "counts above 65,535")],
)
def test_what_is_no_reflectance_is_left_out_with_a_word(tmp_path, suffix, values, why):
    scan = read_scan(written(tmp_path, suffix, {"intensity": values}))
    assert scan.reflectance is None
    assert torch.equal(scan.points_xyz_m, xyz_of(TABLE))
    assert len(scan.notes) == 1
    assert scan.notes[0].startswith(f"intensity of {values.min():g} to ")
    assert why in scan.notes[0]


@pytest.mark.parametrize(
    ("kind", "count", "highest", "scale"),
    [("fractions", 1, 2, 1), ("fractions", 1, 200_000, 1), ("fractions", 200, 2, 255), ("zeros and ones", 1, 2, 255)],
)
def test_a_few_values_above_fractions_of_1_leave_the_others_as_they_are(tmp_path, kind, count, highest, scale):
    values = INTENSITY / 255 * 0.9 if kind == "fractions" else (INTENSITY > 90).astype(np.float32)
    values[:count] = highest
    scan = read_scan(written(tmp_path, ".csv", {"intensity": values}))
    assert scan.reflectance is not None
    assert scan.full_scale == scale
    assert torch.allclose(scan.reflectance, torch.from_numpy(values / scale).clamp(max=1), rtol=1e-5)
    told = f"1 of {len(values):,} values of intensity set to 1, of up to {highest:g}: most are fractions of 1"
    assert scan.notes == ((told,) if scale == 1 else ())


def test_a_little_below_zero_is_zero(tmp_path):
    values = (INTENSITY / 255 - INTENSITY.min() / 255 - 0.0078).astype(np.float32)
    scan = read_scan(written(tmp_path, ".pcd", {"intensity": values}))
    assert scan.reflectance is not None
    assert torch.equal(scan.reflectance, torch.from_numpy(values).clamp(min=0))


@pytest.mark.parametrize("suffix", [".pcd", ".csv", ".npz", ".ply"])
def test_names_that_may_be_meant_are_told(tmp_path, suffix):
    scan = read_scan(written(tmp_path, suffix, {"laser_id": TABLE["ring"], "scalar_Scalar_field": INTENSITY}))
    assert scan.reflectance is None
    assert scan.ring is None
    assert scan.notes == ("columns 'laser_id', 'scalar_field' left alone; rename what is intensity or ring to that",)


def test_negative_values_without_a_name_show_another_layout(tmp_path):
    np.save(tmp_path / "a.npy", np.c_[xyz_of(TABLE).numpy(), -INTENSITY])
    with pytest.raises(ValueError, match="check the layout"):
        read_scan(tmp_path / "a.npy")


def test_verbs_say_what_was_left_out(tmp_path, capsys):
    path = written(tmp_path, ".pcd", {"intensity": np.round(-90 + INTENSITY / 5, 2), "ring": TABLE["ring"]})
    told = "left out: negative values, such as decibels, are no reflectance; scale it to 0 to 1 to keep it"
    for words in (
        ["inspect", str(path), "--sensor", "vlp16"],
        ["export", str(path), str(tmp_path / "out"), "--format", "npz"],
        ["prepare", str(path), "-o", str(tmp_path / "prepared"), "--sensor", "vlp16", "--set", "data.columns=90"],
        ["fit-sensor", str(path), "-o", str(tmp_path / "mine.json")],
        ["complete", str(path), str(tmp_path / "completed"), "--model", "linear"],
        ["rescan", str(path), str(tmp_path / "rescanned"), "--to", "hdl32e"],
    ):
        assert main(words) == 0
        output = capsys.readouterr()
        assert told in output.out + output.err, words[0]


def test_a_name_with_a_newline_forges_no_line_of_inspect(tmp_path, capsys):
    path = written(tmp_path, ".pcd", {"intensity": INTENSITY})
    path = path.rename(tmp_path / "scan\nWARNING: all rows are full.pcd")
    assert main(["inspect", str(path), "--sensor", "vlp16"]) == 0
    assert "scan\\nWARNING: all rows are full.pcd" in capsys.readouterr().out.splitlines()[0]
