"""What a run, and what samples, tell of the scans that a model learned from."""

import json

import pytest

from lidargrit.core.errors import CheckpointError
from lidargrit.data.images import Provenance
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.run_folder import trained_on, write_trained_on
from lidargrit.data.sources import load_range_images
from lidargrit.training.run import _write_trained_on


def test_a_run_that_gives_its_stages_tells_what_it_learned_from_if_it_is_known(tmp_path):
    """Imported weights do not tell it, and a file that was edited by hand may hold anything."""
    config = DataConfig(train=("simulated:6:train",), val=(), columns=512, column_stride=8)
    images = load_range_images(config.train, config)
    (tmp_path / "donor").mkdir()
    _write_trained_on(tmp_path / "first", images, [str(tmp_path / "donor")])
    known = json.loads((tmp_path / "first" / "trained_on.json").read_text())["fingerprints"]
    assert len(known) == 6
    (tmp_path / "donor" / "trained_on.json").write_text('{"recordings": [], "fingerprints": ["ab"]}')
    _write_trained_on(tmp_path / "second", images, [str(tmp_path / "donor")])
    assert json.loads((tmp_path / "second" / "trained_on.json").read_text())["fingerprints"] == sorted([*known, "ab"])
    for number, bad in enumerate(('{"recordings": [[1]]}', '{"fingerprints": 3}', '{"drives": []}', "[]")):
        (tmp_path / "donor" / "trained_on.json").write_text(bad)
        with pytest.raises(CheckpointError, match=r"trained_on\.json, "):
            _write_trained_on(tmp_path / f"bad{number}", images, [str(tmp_path / "donor")])


def test_numbered_recordings_are_written_as_the_first_and_the_last(tmp_path):
    lone = ["a/x", "a/x1", "b/08", "b/09", "b/9", "c/99", "c/100", "drive", "simulated/seed_0000000"]
    numbered = [f"simulated/seed_{seed:07d}" for seed in (*range(7, 12), *range(9_999_997, 10_000_000))]
    write_trained_on(tmp_path, Provenance(recordings=(*reversed(lone), *numbered, "", "drive")))
    written = json.loads((tmp_path / "trained_on.json").read_text())["recordings"]
    assert sorted(each for each in written if isinstance(each, str)) == sorted(lone)
    assert [each for each in written if isinstance(each, dict)] == [
        {"first": "simulated/seed_0000007", "last": "simulated/seed_0000011"},
        {"first": "simulated/seed_9999997", "last": "simulated/seed_9999999"},
    ]
    assert trained_on(tmp_path).recordings == tuple(sorted([*lone, *numbered]))


@pytest.mark.parametrize("last", ["b9", "a09", "a00000003", "a3", "a", "", 7, "a99999999"])
def test_names_that_are_not_numbered_or_too_many_are_refused(last, tmp_path):
    (tmp_path / "trained_on.json").write_text(json.dumps({"recordings": [{"first": "a00000004", "last": last}]}))
    with pytest.raises(CheckpointError, match=r"trained_on\.json, in which"):
        trained_on(tmp_path)
