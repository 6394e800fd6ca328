"""Work shared by a Ray cluster of two nodes on this machine, some of whose parts are killed: the same files each time.

The library is large, so these tests run where it is installed, in an environment of its own; without it all but the
first are skipped.
"""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import yaml

from lidargrit.cli import main
from lidargrit.core.errors import DataError
from lidargrit.core.shares import each_done
from lidargrit.data.prepared import prepare
from tiny_runs import contents

SHARD_SCANS, SCANS = 2, 16
SENSOR = "vlp16"
MEMORY = {"object_store_memory": 80 * 2**20}
PREPARE = f"""
import sys
from lidargrit.cli import main
from lidargrit.data.prepared import prepare
prepare._SHARD_SCANS = {SHARD_SCANS}
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1", "nonsense", "ray://", "HOST:70000"])
def test_an_address_where_no_cluster_answers_is_told_in_one_line(address, tmp_path, capsys):
    assert main(["simulate", str(tmp_path / "out"), "-n", "1", "--ray", address]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith(f"lidargrit simulate: got --ray {address}, where no cluster answers")
    assert error.endswith("check the address, or start one: ray start --head")
    assert not (tmp_path / "out").exists()


def test_the_library_is_asked_for_where_it_is_missing_and_a_rank_beside_it_is_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        assert main(["prepare", "simulated:4@vlp16", "-o", str(tmp_path / "out"), "--ray", address]) == 2
    assert "pip install 'lidargrit[ray]'" in capsys.readouterr().err
    assert main(["sample", "pretrained", str(tmp_path / "out"), "--ray", "auto", "--rank", "1"]) == 2
    assert "leave --rank and --world-size out" in capsys.readouterr().err


def test_the_examples_for_clusters_are_well_formed():
    page = (Path(__file__).parents[1] / "docs/how-to/many-gpus.md").read_text(encoding="utf-8")
    (script,), (job,) = (re.findall(rf"```{kind}\n(.*?)```", page, re.DOTALL) for kind in ("bash", "yaml"))
    subprocess.run(["bash", "-n"], input=script, text=True, check=True)
    parsed = yaml.safe_load(job)
    ((workers,), head) = (parsed["spec"]["rayClusterSpec"][one] for one in ("workerGroupSpecs", "headGroupSpec"))
    assert workers["template"] == head["template"], "head and workers see the same folders"
    assert parsed["spec"]["entrypoint"].startswith("lidargrit prepare ")


@pytest.fixture(scope="module")
def cluster():
    """Start a head and a node with a processor each; both send no usage data."""
    utils = pytest.importorskip("ray.cluster_utils")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        head = {"num_cpus": 1, "include_dashboard": False, **MEMORY}
        cluster = utils.Cluster(initialize_head=True, head_node_args=head)
        cluster.add_node(num_cpus=1, **MEMORY)
        yield cluster
        cluster.shutdown()


@pytest.fixture(scope="module")
def streets(tmp_path_factory):
    """Return scans as files, and what one process prepares of them."""
    folder = tmp_path_factory.mktemp("streets")
    assert main(["simulate", str(folder / "tree"), "-n", str(SCANS), "--sensor", SENSOR, "--workers", "1"]) == 0
    source = f"kitti_odometry:{folder / 'tree'}"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prepare, "_SHARD_SCANS", SHARD_SCANS)
        assert main(["prepare", source, "-o", str(folder / "wanted"), "--sensor", SENSOR, "--workers", "1"]) == 0
    return source, folder


def command(streets, out, address):
    words = ["prepare", streets[0], "-o", str(out), "--sensor", SENSOR, "--ray", address]
    return [sys.executable, "-c", PREPARE, *words]


def workers_at_work():
    psutil = pytest.importorskip("psutil")
    return [each for each in psutil.process_iter(["name"]) if each.info["name"].startswith("ray::_done_in")]


def made(folder: Path) -> int:
    return len([*folder.glob("made/*.json")])


def wait_for(is_so, seconds=200.0):
    end = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_cluster_writes_what_one_process_writes(cluster, streets, tmp_path, capsys):
    words = ["simulate", str(tmp_path / "tree"), "-n", str(SCANS), "--sensor", SENSOR]
    assert main([*words, "--ray", cluster.address]) == 0
    assert f"simulating: {SCANS}/{SCANS}" in capsys.readouterr().err
    assert contents(tmp_path / "tree") == contents(streets[1] / "tree")
    samples = ["sample", "pretrained", "-n", "3"]
    assert main([*samples[:2], str(tmp_path / "here"), *samples[2:]]) == 0
    assert main([*samples[:2], str(tmp_path / "there"), *samples[2:], "--ray", cluster.address]) == 0
    assert contents(tmp_path / "here") == contents(tmp_path / "there")
    assert main([*samples[:2], str(tmp_path / "none"), "--set", "sampling.x=1", "--ray", cluster.address]) == 2
    assert "got" in capsys.readouterr().err.splitlines()[-1]


def test_a_cluster_completes_and_tells_what_it_leaves_out_as_one_process_does(cluster, streets, tmp_path, capsys):
    scans = tmp_path / "scans"
    scans.mkdir()
    for file in sorted((streets[1] / "tree").glob("sequences/*/velodyne/*.bin"))[:4]:
        (scans / file.name).write_bytes(file.read_bytes())
    (scans / "000009.bin").write_bytes(b"cut")
    words = ["--sensor", SENSOR, "--model", "nearest", "--bad-scans", "skip"]
    told = []
    for where in ("here", "there"):
        out = tmp_path / "out"  # which files name
        ray = ["--ray", cluster.address] if where == "there" else []
        assert main(["complete", str(scans), str(out), *words, *ray]) == 0
        told.append({line for line in capsys.readouterr().err.splitlines() if line.startswith("left out: ")})
        out.rename(tmp_path / where)
    assert contents(tmp_path / "here") == contents(tmp_path / "there")
    assert len(told[0]) == 1
    assert told[0] == told[1]


def test_a_cluster_scores_as_one_process_does(cluster, tmp_path):
    words = ["evaluate", f"simulated:4@{SENSOR}", f"simulated:4@{SENSOR}:val", "--metrics", "bev_jsd", "bev_mmd"]
    found = []
    for ray in ([], ["--ray", cluster.address]):
        scores = tmp_path / f"scores{len(ray)}.json"
        assert main([*words, "--groups", "4", "--json", str(scores), *ray]) == 0
        card = json.loads(scores.read_text())
        found.append({"scores": [{**score, "seconds": 0} for score in card.pop("scores")], **card, "sha256": ""})
    assert found[0] == found[1]
    assert main([*words[:3], "--protocol", "streets", "--ray", cluster.address]) == 2


def test_a_cluster_completes_and_compresses_samples_as_one_process_does(cluster, tmp_path):
    samples, out = tmp_path / "samples", tmp_path / "out"
    assert main(["sample", "pretrained", str(samples), "-n", "2"]) == 0
    for where, ray in (("here", []), ("there", ["--ray", cluster.address])):
        out.mkdir()
        filled = ["complete", str(samples), str(out / "filled"), "--observed", "rows:4", "--format", "image"]
        assert main([*filled, *ray]) == 0
        assert main(["compress", str(samples), str(out / "scans.lgz"), *ray]) == 0
        out.rename(tmp_path / where)
    assert contents(tmp_path / "here") == contents(tmp_path / "there")


@pytest.mark.parametrize("dies", ["worker", "node"])
def test_what_dies_is_made_up_for(cluster, streets, tmp_path, dies):
    out = tmp_path / "out"
    told_to_end = signal.getsignal(signal.SIGTERM)
    node = cluster.add_node(num_cpus=2, **MEMORY) if dies == "node" else None
    signal.signal(signal.SIGTERM, told_to_end)  # which a new node takes
    with subprocess.Popen(command(streets, out, cluster.address), stderr=subprocess.PIPE, text=True) as driver:
        reader = threading.Thread(target=lambda: lines.append(driver.stderr.read()), daemon=True)
        lines: list[str] = []
        reader.start()
        wait_for(lambda: made(out) >= 2)
        if node is not None:
            cluster.remove_node(node, allow_graceful=False)
        else:
            for worker in workers_at_work():
                worker.kill()
        assert made(out) < SCANS // SHARD_SCANS, "it came too late to disturb"
        assert driver.wait(200) == 0
        reader.join()
    assert contents(out) == contents(streets[1] / "wanted"), lines


def test_a_driver_that_was_killed_is_started_again(cluster, streets, tmp_path):
    out = tmp_path / "out"
    with subprocess.Popen(command(streets, out, cluster.address), stderr=subprocess.DEVNULL) as driver:
        wait_for(lambda: made(out) >= 2)
        driver.send_signal(signal.SIGKILL)
    assert made(out) < SCANS // SHARD_SCANS
    again = subprocess.run(command(streets, out, cluster.address), capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stderr
    assert contents(out) == contents(streets[1] / "wanted")


def test_a_share_that_kills_every_worker_ends_in_one_line(cluster):
    with pytest.raises(DataError, match=r"a worker of the cluster that died .*the same command goes on"):
        list(each_done(os._exit, [1], ray=cluster.address))
