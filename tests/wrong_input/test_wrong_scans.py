"""Scans, folders and words that cannot be used: one line that says what to do, and nothing lost."""

import re
import shutil

import numpy as np
import pytest

from lidargrit.cli import main
from tiny_runs import MODEL, SHORT, SIMULATED, train_words


def changed(rows: np.ndarray, name: str) -> bytes:
    """Return a damaged scan as the bytes of a file."""
    bad = rows.copy()
    if name == "NaN":
        bad[7, 0] = np.nan
    elif name == "infinite":
        bad[7:9, 2] = -np.inf
    elif name == "origin":
        bad[7, :3] = 0
    elif name == "reflectance":
        bad[:, 3] *= 255
    return {"cut short": bad.tobytes()[:-3], "empty": b""}.get(name, bad.tobytes())


DAMAGE = {
    "cut short": r"got \d+ bytes in .*BAD.*, 13 more than whole points; wanted .*16 bytes a point; download it again",
    "empty": r"got an empty file, .*BAD.*; wanted float32 rows .*; download it again, or remove it",
    "NaN": r"got 1 of \d+ points with NaN or infinite coordinates in .*BAD.*; .*--bad-points drop",
    "infinite": r"got 2 of \d+ points with NaN or infinite coordinates in .*BAD.*; .*--bad-points drop",
    "origin": r"got 1 of \d+ points at the origin .* in .*BAD.*; .*--bad-points drop",
    "reflectance": r"got reflectance from 0 to \d+.* in .*BAD.*; wanted values in \[0, 1\]; .*divide",
}


@pytest.mark.parametrize(
    ("verb", "damage"), [*(("view", each) for each in DAMAGE), ("train", "NaN"), ("evaluate", "empty"), ("demo", "NaN")]
)
def test_a_damaged_scan(refused, rows, tmp_path, verb, damage):
    folder = tmp_path / "scans"
    folder.mkdir()
    for index in range(8):
        (folder / f"{index:06d}.bin").write_bytes(changed(rows, "not at all"))
    (folder / "000001.bin").write_bytes(changed(rows, damage))
    words = {
        "train": [*train_words(tmp_path / "run"), f"data.train=[{folder}]"],
        "view": ["view", folder, "-o", tmp_path / "picture.png", "-n", 8],
        "evaluate": ["evaluate", folder, "simulated:1:test", "--json", tmp_path / "scores.json"],
        "demo": ["demo", "--data", folder, "--out", tmp_path / "run", "--set", *MODEL, *SHORT],
    }[verb]
    assert re.search(DAMAGE[damage].replace("BAD", re.escape("scans/000001.bin")), refused(*words))


def test_bad_points_are_dropped_by_the_setting_that_the_message_names(refused, rows, tmp_path):
    (tmp_path / "scans").mkdir()
    words = [*train_words(tmp_path / "run"), f"data.train=[{tmp_path / 'scans'}]", f"data.val=[{tmp_path / 'scans'}]"]
    for damage, name in (("infinite", "000001.bin"), ("origin", "000000.bin")):  # the first bad scan is told
        (tmp_path / "scans" / name).write_bytes(changed(rows, damage))
        message = refused(*words)
        assert name in message
        setting = re.findall(r"--bad-points|(?<=--bad-points )\w+", message)
        assert len(setting) == 2
    assert main([*words, *setting]) == 0, "the same folder can be used: nothing had begun"
    assert (tmp_path / "run" / "model.safetensors").exists()


def test_bad_scans_are_left_out_by_the_setting_that_the_message_names(refused, rows, tmp_path, capsys):
    (tmp_path / "scans").mkdir()
    words = [*train_words(tmp_path / "run"), f"data.train=[{tmp_path / 'scans'}]"]
    bad = {"000003.bin": "cut short", "000002.bin": "NaN", "000001.bin": "reflectance"}  # the first bad scan is told
    for name in ("000000.bin", "000004.bin"):
        (tmp_path / "scans" / name).write_bytes(changed(rows, "not at all"))
    for name, damage in bad.items():
        (tmp_path / "scans" / name).write_bytes(changed(rows, damage))
        message = refused(*words)
        assert name in message
        setting = re.findall(r"--bad-scans|(?<=--bad-scans )\w+", message)
        assert len(setting) == 2
    assert main([*words, *setting]) == 0
    output = capsys.readouterr().err
    assert output.count("left out: got ") == len(bad)
    assert all(name in output for name in bad)
    (tmp_path / "scans" / "000000.bin").unlink()
    (tmp_path / "scans" / "000004.bin").unlink()
    assert "no usable scan in" in refused(*train_words(tmp_path / "none"), *words[-1:], *setting)


REAL_DAMAGE = {
    "incomplete_sweep_39_rings": r"got 39 rings in .*; wanted the 64 rings .*; remove the file if the scan was cut",
    "cropped_to_camera": r"got returns in only .* of 360 degrees of azimuth in .*; wanted a full revolution",
    "all_columns_times_1p1_plus_0p1": r"got reflectance from .* to 1.* in .*; wanted values in \[0, 1\]",
}


@pytest.mark.shared
def test_real_damaged_scans(refused, real, rows, tmp_path, capsys):
    (tmp_path / "scans").mkdir()
    words = [*train_words(tmp_path / "run"), f"data.train=[{tmp_path / 'scans'}]"]
    for name, said in REAL_DAMAGE.items():
        scan = tmp_path / "scans" / f"{name}.bin"
        shutil.copy(real / "damaged" / scan.name, scan)
        assert re.search(said, refused("view", tmp_path / "scans", "-o", tmp_path / "picture.png"))
        assert re.search(said, refused(*words))
        scan.rename(tmp_path / scan.name)
    for name in REAL_DAMAGE:
        (tmp_path / f"{name}.bin").rename(tmp_path / "scans" / f"{name}.bin")
    (tmp_path / "scans" / "good.bin").write_bytes(rows.tobytes())
    assert main([*words, "data.bad_scans=skip"]) == 0
    told = capsys.readouterr().err
    assert all(re.search(f"left out: {said}", told) for said in REAL_DAMAGE.values())


def test_a_folder_with_no_scan_in_it(refused, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("no scan")
    for folder, what in (("empty", "is an empty folder"), ("other", "holds"), ("none", "does not exist")):
        source = tmp_path / folder
        for words in (
            [*train_words(tmp_path / "run"), f"data.train=[{source}]"],
            ["demo", "--data", source, "--out", tmp_path / "run"],
            ["evaluate", source, "simulated:1:test"],
            ["view", source, "-o", tmp_path / "picture.png"],
        ):
            assert re.search(f"{folder}, which {what}.*lidargrit list datasets", refused(*words))
    assert "no scan where this data set has them" in refused("view", f"kitti_raw:{tmp_path / 'other'}")


def test_a_sensor_that_does_not_fit_the_scan(refused, tmp_path):
    azimuth, elevation = np.meshgrid(
        np.linspace(0, 2 * np.pi, 900, endpoint=False), np.radians(np.linspace(15, -15, 16))
    )
    flat = np.cos(elevation)
    xyz_m = 10 * np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), axis=-1).reshape(-1, 3)
    (tmp_path / "puck").mkdir()
    np.column_stack((xyz_m, np.full(len(xyz_m), 0.5))).astype("<f4").tofile(tmp_path / "puck" / "0.bin")
    settings = [f"data.train=[{tmp_path / 'puck'}]", "data.sensor=hdl64e_kitti_360", "data.projection=spherical"]
    message = refused(*train_words(tmp_path / "run", *settings))
    assert re.search(
        r"got \d\d% of the points of .*puck/0\.bin outside the sensor's elevations .*-15.0 to 15.0", message
    )
    assert re.search(r"wanted -2\d\.\d to \d\.\d degrees for 'hdl64e_kitti_360'; .*lidargrit fit-sensor", message)
    message = refused(*train_words(tmp_path / "run", *settings[:1]))
    assert re.search(
        r"got 16 rings in .*puck/0\.bin; wanted the 64 rings of the sensor 'hdl64e_kitti_odometry'", message
    )


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (
            ["train", "lidargrit_smal", "OUT"],
            r"'lidargrit_smal', which is not among the presets; wanted one such as lidargrit_small.*list presets",
        ),
        (
            ["train", "lidargrit_demo", "OUT", "--set", "seed"],
            r"the setting 'seed'; wanted NAME=VALUE; e\.g\. --set title=",
        ),
        (
            ["train", "lidargrit_demo", "OUT", "--set", "model.tokenizer.chanels=32"],
            r"'model\.tokenizer\.chanels', which .*channels",
        ),
        (
            ["train", "lidargrit_demo", "OUT", "--set", "training.tokeniser.scans=4"],
            r"wanted one such as training\.tokenizer\.scans",
        ),
        (["train", "lidargrit_demo", "OUT", "--set", "seed=many"], r"seed=many; wanted a whole number"),
        (["train", "lidargrit_demo", "OUT", "--set", "data.train=[]"], r"no source of scans; .*data\.train="),
        (
            ["train", "lidargrit_demo", "OUT", "--set", "data.train=[kiti_odometry:/d]"],
            r"'kiti_odometry', which .*kitti_odometry",
        ),
        (
            ["train", "lidargrit_demo", "OUT", "--set", "data.train=[simulated]"],
            r"the source 'simulated' alone; .*simulated:1000",
        ),
        (
            ["train", "lidargrit_demo", "OUT", "--set", "data.sensor=hdl64"],
            r"'hdl64', which is not among the sensors; .*hdl64e_",
        ),
        (["train", "lidargrit_demo", "OUT", "--set", "data.sensor=no.json"], r"no\.json, which cannot be read"),
        (
            ["train", "lidargrit_demo", "OUT", "--set", "data.columns=100", "data.column_stride=8"],
            r"100 columns, one in 8 kept",
        ),
        (["train", "lidargrit_demo", "OUT", "--set", "data.columns=80"], r"range images of 64x10; .*divisible by 8"),
        (
            ["train", "lidargrit_demo", "OUT", "--set", "generator=lidargri"],
            r"'lidargri', which is not among the generators",
        ),
        (["train", "lidargrit_demo", "OUT", "--set", "model.tokenizer.channels=40"], r"channels=40; .* multiple of 32"),
        (["train", "lidargrit_demo", "OUT", "--set", "data.max_scans=-1"], r"max_scans=-1; wanted"),
        (["train", "lidargrit_demo", "OUT", "--set", "seed=-1"], r"seed=-1; wanted"),
        (
            ["train", "lidargrit_demo", "OUT", "--set", "training.tokenizer.betas=[2.0,3.0]"],
            r"betas=\[2\.0,3\.0\]; wanted 2 values, each a number",
        ),
        (
            ["train", "lidargrit_demo", "OUT", "--set", "training.tokenizer.weight_decay=-1"],
            r"weight_decay=-1; wanted",
        ),
        (
            ["train", "lidargrit_demo", "OUT", "--set", "model.transformer.residual_dropout=2"],
            r"residual_dropout=2; wanted",
        ),
        (
            ["train", "lidargrit_demo", "OUT", "--set", "training.tokenizer.average_over_scans=-1"],
            r"average_over_scans=-1; wanted",
        ),
        (["sample", "RUN", "OUT", "-n", "0"], r"-n 0; wanted a whole number from 1 "),
        (["sample", "RUN", "OUT", "--seed", "-1"], r"--seed -1; wanted"),
        (["sample", "RUN", "OUT", "--set", "sampling.top_p=0"], r"top_p=0; wanted"),
        (["sample", "RUN", "OUT", "--set", "sampling.temperature=nan"], r"temperature=nan; wanted a number, at least"),
        (
            ["sample", "RUN", "OUT", "--set", "sampling.temprature=1"],
            r"'temprature', which sampling with 'lidargrit' does not have; wanted one such as temperature; .*list gen",
        ),
        (["sample", "RUN", "OUT", "--set", "sampling.mask=never"], r"mask=never; wanted auto, .*threshold"),
        (["sample", "RUN", "OUT", "--device", "gpu"], r"device 'gpu'; wanted"),
        (["sample", "nowhere", "OUT"], r"nowhere, which does not exist; .*pretrained"),
        (
            ["evaluate", "simulated:1", "simulated:1", "--metrics", "slice"],
            r"'slice', which .*metrics; .*sliced_wasserstein",
        ),
        (["evaluate", "simulated:1", "simulated:1", "-n", "-1"], r"-n -1; wanted a whole number from 0"),
        (["evaluate", "simulated:1", "simulated:1", "--seed", "-1"], r"seed.*-1; wanted"),
        (["evaluate", "SAMPLES", "SAMPLES", "-n", "-1"], r"-n -1; wanted a whole number from 0"),
        (["evaluate", "simulated:1:val", "SAMPLES"], r"64x\d+.*; wanted the rays of .*give the samples first"),
        (["view", "simulated:1", "-o", "OUT.png", "-n", "0"], r"-n 0.*; wanted|0 scans.*; wanted"),
        (["view", "simulated:9", "-o", "OUT.png", "-n", "9"], r"; wanted .*1 to 8"),
        (["view", "RUN", "-o", "OUT.png", "-n", "9"], r"; wanted .*1 to 8"),
        (["view", "simulated:1", "-o", "RUN/run.json/x.png"], r"run\.json is a file; wanted a folder"),
        (["demo", "--data", "simulated:many", "--out", "OUT"], r"'many' where a count belongs"),
    ],
)
def test_wrong_words(refused, finished, tmp_path, words, text):
    for word, path in (("OUT", tmp_path / "out"), ("RUN", finished["run"]), ("SAMPLES", finished["samples"])):
        words = [re.sub(f"^{word}\\b", str(path), each) for each in words]
    if words[0] == "train":
        words = [*words, "--set", *MODEL, *SIMULATED, *SHORT, *words[4:]] if "--set" in words else words
    assert re.search(text, refused(*words))
