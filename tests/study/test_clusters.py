"""Studies on a Ray cluster and through submitit, with real processes."""

import subprocess
import sys
import time

import pytest

from tests import studies
from tests.helpers import ROOT

LONGER = [
    "--total-steps",
    str(64 * 800),
    "--checkpoint-every",
    str(64 * 100),
    "--algos",
    "ppo",
    "--seeds",
    "0",
    "1",
    "2",
]
"""Three cells of a few seconds each."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The rows of a study that was not disturbed; one run at a time has all cores, as the others have, on which its bits depend."""
    study = tmp_path_factory.mktemp("studies") / "whole"
    assert studies.finish(studies.start(study, *LONGER, "--processes", "1"))[0] == 0
    return studies.rows(study)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Ray's
def test_when_a_node_of_a_ray_cluster_dies_its_cells_go_on_elsewhere_to_the_same_bits(
    whole, tmp_path
):
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        second = cluster.add_node(num_cpus=1)
        process = studies.start(
            tmp_path / "study", *LONGER, "--launcher", "ray", "--address", cluster.address
        )
        until = time.monotonic() + 180
        while (
            len(list(tmp_path.glob("study/runs/*/checkpoints/*"))) < 3 and time.monotonic() < until
        ):
            time.sleep(0.05)
        running = len(list(tmp_path.glob("study/runs/*/config.json")))
        cluster.remove_node(second, allow_graceful=False)
        code, lines, errors = studies.finish(process)
    finally:
        cluster.shutdown()
    assert running == 2
    assert (code, errors) == (0, ""), lines
    assert studies.rows(tmp_path / "study") == whole
    logs = [path.read_text() for path in tmp_path.glob("study/logs/*.log")]
    assert sum("resuming from steps_" in log for log in logs) == 1


@pytest.mark.slow
def test_submitit_runs_the_cells_as_jobs(whole, tmp_path):
    pytest.importorskip("submitit")
    program = "from dgae_jax.study import on_slurm\nfrom dgae_jax.cli.reproduce import main\non_slurm.CLUSTER = 'local'\nraise SystemExit(main())"
    words = [
        sys.executable,
        "-c",
        program,
        str(tmp_path / "study"),
        *studies.SHAPE,
        *LONGER,
        "--launcher",
        "slurm",
    ]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=500, check=False)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout
    assert studies.rows(tmp_path / "study") == whole
    assert len(list(tmp_path.glob("study/slurm/*/*result.pkl"))) == 3
