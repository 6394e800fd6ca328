"""The demo: which networks it trains, on whose scans, and what it says of that."""

import shutil

from dataset_examples import write_example
from lidargrit.core import reporting
from lidargrit.data.sources import load_range_images
from lidargrit.generation.settings import Preset
from lidargrit.systems.lidargrit.system import TokenSampling
from lidargrit.training.measure import Measured
from lidargrit.viewer import demo


def test_demo_takes_the_preset_that_suits_the_scans(tmp_path, capsys, monkeypatch):
    stage = Measured("transformer", 1, 1.0, 12.5, "cpu", 0.5)  # a measurement itself takes half a minute
    monkeypatch.setattr(demo, "measure", lambda preset: [stage])

    def chosen(*settings: str, data: str | None = None, anew: bool = False) -> tuple[Preset, str, str]:
        with reporting.to(reporting.TerminalReporter()):
            preset = demo._preset(data, [*settings], anew)
        return preset, demo.how_trained(preset), capsys.readouterr().err

    preset, words, said = chosen()
    expected_s = demo._expected_s(preset, simulates=True)
    assert [*expected_s] == ["projecting scans", "training transformer", "sampling", "scoring"]
    assert expected_s["training transformer"] == 12.5
    assert words.startswith("The tokenizer and the pixel decoder come as trained, from the model in the package")
    assert words.endswith("The transformer learns further here, from the weights of that model.")
    assert said == ""
    assert demo._sampling(preset) == TokenSampling()
    for settings, anew in ((["data.columns=512", "data.column_stride=8"], False), ([], True)):
        preset, words, said = chosen(*settings, anew=anew)
        assert words == "The tokenizer, the transformer and the pixel decoder learn anew here."
        assert ("another sensor" in said) != anew
        assert demo._sampling(preset) == demo._SHARPER
    write_example("kitti_odometry", tmp_path / "tree", 1)
    (scan,) = (tmp_path / "tree" / "sequences" / "00" / "velodyne").iterdir()
    for number in range(1, 4):
        shutil.copy(scan, scan.with_stem(f"{number:06d}"))
    preset, _, said = chosen(data=str(tmp_path / "tree" / "sequences" / "00"))
    assert "WARNING: the last scans are held out" in said
    assert (preset.data.train[0][-6:], preset.data.val[0][-6:]) == ("[:85%]", "[85%:]")
    divided = (preset.data.train, preset.data.val)
    assert [len(load_range_images(sources, preset.data)) for sources in divided] == [3, 1]
    assert preset.start_runs == dict.fromkeys(("tokenizer", "transformer", "pixels"), "pretrained")
    assert not preset.frozen
