"""Studies on clusters of local processes, on small disks, and read by ``zarr`` alone."""

import os
import subprocess
import threading
import time

import numpy as np
import pytest
import zarr

import liethermo as lt

from .cases import RATES, content, study

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


def long_study(store, **changes):
    """Return a study of many chunks that take a tenth of a second each."""
    axes = {"rate": RATES, "ratio": np.linspace(0.1, 0.6, 64)}
    return study(store, axes, t_span=(0.0, 400.0), step=0.01, **changes)


@pytest.fixture(scope="module")
def reference_content(tmp_path_factory):
    store = tmp_path_factory.mktemp("clusters") / "whole.zarr"
    assert long_study(store).run().complete
    return content(store)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2, 4])
def test_any_number_of_workers_makes_the_same_store(workers, reference_content, tmp_path):
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        assert long_study(tmp_path / "s.zarr").run(client, progress=True).complete
    assert content(tmp_path / "s.zarr") == reference_content


@pytest.mark.slow
def test_a_worker_that_dies_and_one_that_comes_lose_nothing(reference_content, tmp_path):
    from distributed import Client, LocalCluster

    store, statuses = tmp_path / "s.zarr", []

    def disturb(cluster):
        while not store.exists() or not (len(list((store / "status/c").rglob("*"))) > 20 or statuses):
            time.sleep(0.01)
        pids = [worker.pid for worker in cluster.workers.values()]
        cluster.scale(3)
        os.kill(pids[0], 9)
        statuses.append(long_study(store).status())

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:
        thread = threading.Thread(target=disturb, args=(cluster,))
        thread.start()
        assert long_study(store).run(client).complete
        thread.join()
        client.wait_for_workers(3, timeout=60)  # a process takes longer to start than what is left to do
    assert 0 < statuses[0].done < statuses[0].points
    assert statuses[0].running["pid"] == os.getpid()
    assert content(store) == reference_content


@pytest.mark.slow
def test_a_disk_that_fills(reference_content, tmp_path):
    """A tmpfs that is too small for the study, and is enlarged later."""
    folder = tmp_path / "small"
    folder.mkdir()
    mount = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=600k", "none", str(folder)], capture_output=True)
    if mount.returncode:
        pytest.skip("only root can mount")
    try:
        with pytest.raises(lt.FileError, match=r"the disk is full .*Finished chunks are saved"):
            long_study(folder / "s.zarr").run()
        status = long_study(folder / "s.zarr").status()
        assert 0 < status.done < status.points
        subprocess.run(["mount", "-o", "remount,size=64m", str(folder)], check=True)
        assert long_study(folder / "s.zarr").run().complete
        assert content(folder / "s.zarr") == reference_content
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def test_zarr_alone_reads_a_store(tmp_path):
    """``zarr`` is an independent reader of the files that the library writes."""
    parameter_study = study(tmp_path / "s.zarr", names={"rate": "friction"}, units={"rate": "1/s", "tau": "s"})
    parameter_study.run()
    for use_consolidated in (True, False):
        group = zarr.open_group(tmp_path / "s.zarr", mode="r", use_consolidated=use_consolidated)
        assert group.metadata.zarr_format == 3
        results = parameter_study.results
        for name in ("tau", "final", "laws", "status", "message", "rate", "quantity"):
            values = np.asarray(group[name][...])
            expected_values = results[name].values
            assert np.array_equal(values, expected_values, equal_nan=values.dtype.kind == "f"), name
            assert group[name].metadata.dimension_names == results[name].dims
    assert group["rate"].attrs.asdict() == {"units": "1/s", "long_name": "friction"}
    assert group["tau"].attrs["units"] == "s"
    assert "pickle" not in str(group.metadata)
