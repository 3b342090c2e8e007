import json
import os
import signal
import threading
import time

import pytest
from shared import rows

from gaussian_swaying.cli.sweep import main

ray = pytest.importorskip("ray")
pytestmark = pytest.mark.timeout(900)


@pytest.fixture(scope="module")
def cluster():
    from ray.cluster_utils import Cluster

    memory = 80 * 2**20
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "object_store_memory": memory})
    made.add_node(num_cpus=1, object_store_memory=memory)
    yield made.address
    ray.shutdown()
    made.shutdown()


def test_a_sweep_on_two_nodes(cluster, undisturbed, tmp_path, sweep_file):
    file, folder = sweep_file(tmp_path / "tiny.yaml"), tmp_path / "out"
    assert main([str(file), "--output", str(folder), "--ray", cluster, "--threads", "1", "--device", "cpu"]) == 0
    assert (folder / "sweep.csv").read_bytes() == (undisturbed / "sweep.csv").read_bytes()
    results = [json.loads(file.read_text()) for file in (folder / "results").iterdir()]
    assert len({result["where"] for result in results}) == 2


def test_a_killed_process_and_failures(cluster, tmp_path, sweep_file):
    axes = {"wind.flow": [[4.0, 1.0, 0.0], [9e3, 0.0, 0.0], [5.0, 1.0, 0.0]]}
    file, folder = sweep_file(tmp_path / "bad.yaml", axes, 1), tmp_path / "out"
    killed = []

    def kill():
        end = time.monotonic() + 300
        while not killed and time.monotonic() < end:
            for lock in (folder / "runs").glob("0000[02]/.gaussian_swaying.lock"):
                try:
                    os.kill(json.loads(lock.read_bytes())["pid"], signal.SIGKILL)
                    killed.append(lock.parent.name)
                    break
                except (OSError, ValueError):
                    continue
            time.sleep(0.01)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    assert main([str(file), "--output", str(folder), "--ray", cluster, "--device", "cpu"]) == 2
    killer.join()
    assert killed, "no run that can end well was met alive"
    assert [row["status"] for row in rows(folder / "sweep.csv")] == ["complete", "diverged", "complete"]
    attempts = [json.loads((folder / f"results/0000{run}.json").read_text())["attempts"] for run in range(3)]
    assert attempts[1] == 2
    assert attempts[int(killed[0])] >= 2
    done = {path: path.stat().st_mtime_ns for path in (folder / "results").glob("0000[02].json")}
    assert main([str(file), "--output", str(folder), "--ray", cluster, "--device", "cpu", "--resume"]) == 2
    assert {path: path.stat().st_mtime_ns for path in done} == done


def test_no_cluster_at_the_address(tmp_path, sweep_file, capsys, monkeypatch):
    monkeypatch.setenv("RAY_gcs_server_request_timeout_seconds", "1")
    file = sweep_file(tmp_path / "tiny.yaml")
    ray.shutdown()
    assert main([str(file), "--output", str(tmp_path / "out"), "--ray", "no such place", "--device", "cpu"]) == 2
    assert "check `--ray`" in capsys.readouterr().err
