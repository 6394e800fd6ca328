"""What a training says and plans: its log, TensorBoard's files, the settings of stages, and measured costs."""

import json
import re
import sys
from dataclasses import replace

from lidargrit.generation.presets import load_preset
from lidargrit.training import measure, training_flops
from lidargrit.training.log import Log, read_log
from test_training import TINY


def test_stages_use_their_own_settings():
    preset = load_preset("lidargrit_demo", ["training.transformer.learning_rate=0.5"])
    assert preset.training["transformer"].learning_rate == 0.5
    assert preset.training["tokenizer"] == load_preset("lidargrit_demo").training["tokenizer"]
    assert replace(preset, seed=1) != preset


def test_a_measured_plan_tells_operations_time_and_memory():
    preset = load_preset("lidargrit_demo", TINY)
    lines = [stage.as_text() for stage in measure(preset)]
    for line, (stage, flops) in zip(lines, training_flops(preset).items(), strict=True):
        wanted = rf"{stage}: {flops:.2e} floating-point operations at [\d.e+]+ scans/s: [\d.]+ \w+ on cpu, [\d.]+ GiB"
        assert re.fullmatch(wanted.replace("e+", "e\\+", 1), line)


def test_lines_that_are_no_entries_of_a_log_are_passed_over(tmp_path):
    good = '{"scans_seen": 4, "split": "train", "seconds": 1.5}\n'
    bad = [
        "{}",
        "[]",
        "null",
        '{"scans_seen": "4", "seconds": 1}',
        "[" * 50_000,
        '{"a": 1e400}',
        '{"scans_seen": 4, "se',
    ]
    content = "".join(f"{line}\n" for line in (good.strip(), *bad, good.strip())).encode() + b"\xff\xfe"
    (tmp_path / "log.jsonl").write_bytes(content)
    assert [entry["seconds"] for entry in read_log(tmp_path / "log.jsonl")] == [1.5, 1.5]
    Log(tmp_path, 4).write("val", 8, 2.0, {"loss": float("nan")})
    lines = (tmp_path / "log.jsonl").read_text().splitlines()
    assert lines[:-1] == [good.strip()] * 2
    assert json.loads(lines[-1])["loss"] is None


def test_tensorboard_draws_what_the_log_says(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = Log(tmp_path, 0)
    log.write("train", 4, 1.0, {"loss": 0.5})
    log.write("train", 8, 2.0, {"loss": 0.25})
    log.close()
    again = Log(tmp_path, 4)  # killed after the checkpoint at 4 scans
    again.write("train", 8, 2.0, {"loss": 0.125})
    again.close()
    seen = EventAccumulator(str(tmp_path)).Reload().Scalars("loss/train")
    assert [(event.step, event.value) for event in seen] == [(4, 0.5), (8, 0.125)]
    assert [json.loads(line)["loss"] for line in (tmp_path / "log.jsonl").read_text().splitlines()] == [0.5, 0.125]


def test_the_log_is_written_without_tensorboard(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    log = Log(tmp_path, 0)
    log.write("train", 4, 1.0, {"loss": 0.5})
    log.close()
    assert [path.name for path in tmp_path.iterdir()] == ["log.jsonl"]
