"""The one table of classes: the simulator's, SemanticKITTI's, PandaSet's and nuScenes' numbers."""

import json
import re
from collections import Counter

import pytest
import torch

from lidargrit.core.errors import ConfigError
from lidargrit.generation.semantic_classes import NUM_CLASSES, class_indices, class_iou, labels_of
from lidargrit.scans.classes import CLASSES, LEARNED, NUMBERINGS, as_semantic_kitti, unknown_numbers
from lidargrit.scans.sensors import load_sensor
from lidargrit.simulator import simulate

BENCHMARK = {  # learning_map of SemanticKITTI's semantic-kitti.yaml
    0: 0, 1: 0, 10: 1, 11: 2, 13: 5, 15: 3, 16: 5, 18: 4, 20: 5, 30: 6, 31: 7, 32: 8, 40: 9, 44: 10, 48: 11, 49: 12,
    50: 13, 51: 14, 52: 0, 60: 9, 70: 15, 71: 16, 72: 17, 80: 18, 81: 19, 99: 0, 252: 1, 253: 7, 254: 6, 255: 8,
    256: 5, 257: 5, 258: 4, 259: 5,
}  # fmt: skip
GROUPS = {  # of PandaSet's names, by what each of them has
    "road": "^Road$|Marking|Driveway",
    "sidewalk": "Sidewalk",
    "terrain": "Ground",
    "building": "Building",
    "vegetation": "Vegetation",
    "vehicle": "Car|Truck|truck|Towed|Vehicle|Bus|Train|Trolley|Tram",
    "person, cycle": "Pedestrian|Motor|Mobility|Bicycle",
    "pole, sign": "Signs",
}


def test_networks_learn_the_classes_of_the_benchmark():
    numbers = torch.tensor(sorted(CLASSES))
    assert class_indices(numbers).tolist() == [BENCHMARK[number] for number in sorted(CLASSES)]
    assert CLASSES.keys() == BENCHMARK.keys()
    assert NUM_CLASSES == 19
    assert labels_of(class_indices(torch.tensor([0, 1, 40, 252, 9999]))).tolist() == [0, 0, 40, 10, 0]
    assert labels_of(torch.arange(20)).tolist() == [0, *LEARNED]


def test_what_is_truly_of_no_class_does_not_count_and_what_is_wrongly_found_to_be_of_none_does():
    none, first, second, absent = [9, 9, 9, 9], [2, 5, 1, 0], [0, 3, 4, 1], [0, 0, 0, 0]
    iou = class_iou(torch.tensor([none, first, second, absent]))
    assert iou[:2].tolist() == pytest.approx([5 / (8 + 3), 4 / (8 + 1)])
    assert bool(iou[2].isnan())


def test_the_simulator_has_no_label_that_is_forgotten():
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(128)
    seen = Counter()
    for seed in range(6):
        label = simulate(seed=seed, sensor=sensor).label
        assert label is not None
        assert not unknown_numbers(label)
        seen.update((label & 0xFFFF).tolist())
    assert len(seen) >= 12
    assert {number for number in seen if not CLASSES[number].learned} <= {52, 99}


def test_every_number_of_another_numbering_is_one_that_the_viewer_names():
    for numbers in NUMBERINGS.values():
        assert {*numbers.values()} <= CLASSES.keys()
    given = torch.tensor([[7, 9], [13, 41]])
    assert as_semantic_kitti(given | 5 << 16, "pandaset").tolist() == [[40, 60], [10, 50]]
    assert as_semantic_kitti(torch.tensor([0, 10, 4]), "nuscenes").tolist() == [40, 0, 70]


def test_pandasets_own_list_is_whole_and_means_the_same(real):
    listed = json.loads((real / "pandaset/classes.json").read_text())
    names = {int(number): name for number, name in listed.items()}
    assert {0, *names} == NUMBERINGS["pandaset"].keys()
    for number, name in names.items():
        group = CLASSES[NUMBERINGS["pandaset"][number]].group
        assert group == next((each for each, words in GROUPS.items() if re.search(words, name)), ""), name


def test_numbers_that_a_numbering_does_not_have_are_named():
    with pytest.raises(
        ConfigError, match=r"^got labels that semantic_kitti does not have: 5, 41; wanted labels of pand"
    ):
        as_semantic_kitti(torch.tensor([5, 41, 40]), "semantic_kitti")
    with pytest.raises(ConfigError, match=r"^got labels of the numbering 'waymo'; wanted nuscenes, pandaset or semant"):
        as_semantic_kitti(torch.tensor([5]), "waymo")
